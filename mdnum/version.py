"""The version of this package, for those below who write it into files."""

__version__ = "0.1.0"
