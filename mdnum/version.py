"""Version of this package, for modules that write the version to files."""

__version__ = "0.1.0"
