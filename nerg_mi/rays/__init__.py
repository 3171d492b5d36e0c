"""Rays of attention: who looked from where to where, and when; on disk, chosen among, summed up."""
