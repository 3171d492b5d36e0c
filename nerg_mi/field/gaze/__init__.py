"""Gaze fields: what a surface attracts and what an observer gives, as networks of two kinds, and ensembles of them."""

# Imported so that the registry knows them, whichever module of the package is asked for.
from . import ensemble as ensemble
from . import log_density as log_density
from . import product as product
