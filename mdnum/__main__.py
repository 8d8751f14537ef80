"""`python -m mdnum`: the same as `mdnum`."""

from __future__ import annotations

from mdnum.cli import main

if __name__ == "__main__":
    main()
