"""Salience images as densities over directions."""
