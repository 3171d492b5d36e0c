"""What `nerg stats` counts with: things in a place, what is in view, what a field foretells, and what would change."""
