"""Interfaces to other programs and frameworks: scenes for Rerun and OpenUSD, and fields as modules of PyTorch."""
