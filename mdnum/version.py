"""Version of this package, for modules in lower layers that write it to files."""

__version__ = "0.1.0"
