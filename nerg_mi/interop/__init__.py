"""Views of fields in other array frameworks; each module imports its framework, and nothing else of the package
does."""
