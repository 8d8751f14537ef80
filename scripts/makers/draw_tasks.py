"""Draw three tasks per reader from the verbs, with a random seed, for readers who have only the site.

    python scripts/makers/draw_tasks.py --readers 4 --seed 1

Each verb of `mdnum --help` has a task in `tasks.toml` next to this file, in words that a user has before
knowing mdnum. A reader is given the built site, the tasks and an installed `mdnum`, writes down the command
or program that answers each, runs it, and says where the site stopped them. `tasks.toml` keeps that list.
"""

from __future__ import annotations

import argparse
import random
import tomllib
from pathlib import Path

HERE = Path(__file__).parent
#: Tasks of a reader.
EACH = 3


def main() -> None:
    """Draw and print."""
    parser = argparse.ArgumentParser(description="Three tasks for each reader of the site.")
    parser.add_argument("--readers", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    said = parser.parse_args()
    draw = random.Random(said.seed)
    tasks = tomllib.loads((HERE / "tasks.toml").read_text(encoding="utf-8"))["tasks"]
    for reader in range(said.readers):
        print(f"Reader {reader + 1}")
        for number, verb in enumerate(draw.sample(sorted(tasks), EACH)):
            print(f"  {number + 1}. {tasks[verb]}")


if __name__ == "__main__":
    main()
