"""The former place of `nerg_mi.files.checksum.file_sha256`, for modules that still look for it here."""

from nerg_mi.files.checksum import file_sha256

__all__ = ["file_sha256"]
