"""``nerg rays``: tracking files in, rays out, and what is in them. A module for each sub-command."""

from .commands import rays_app as rays_app
