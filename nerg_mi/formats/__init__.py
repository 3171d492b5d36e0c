"""File formats of fields, surfaces and volumes, our own and those of others."""
