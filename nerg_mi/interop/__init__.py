"""Interfaces between fields and other array frameworks. Each module imports its framework."""
