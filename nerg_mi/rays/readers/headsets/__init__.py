"""Headsets whose world is rendered or mixed: the exports of their programs."""
