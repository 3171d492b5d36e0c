"""``nerg rays``: tracking files in, rays out, and what is in them. A module for each sub-command."""

from .commands import app as app
