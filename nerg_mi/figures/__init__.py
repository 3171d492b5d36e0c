"""Figures: heat maps over images, AOV figures, floor plans, and page layout."""
