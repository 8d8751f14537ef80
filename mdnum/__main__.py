"""`python -m mdnum`: the same as `mdnum`."""

from __future__ import annotations

import os
import sys

if __name__ == "__main__" and not sys.flags.safe_path and sys.path[:1] == [os.getcwd()]:
    # Python puts the current folder first; off it goes before a package is looked for there
    del sys.path[0]

from mdnum.cli import main

if __name__ == "__main__":
    main()
