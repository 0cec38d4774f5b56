"""The console script ``sb3-reinforce-zoo``, which is installed with and without the extra ``zoo`` that it needs."""

import importlib
import sys


def main() -> None:
    """Run a command of ``sb3_reinforce.zoo``, or print what to install and exit with status 2."""
    try:
        zoo = importlib.import_module("sb3_reinforce.zoo.__main__")
    except ImportError as error:
        print(f"sb3-reinforce-zoo: error: {error}", file=sys.stderr)
        sys.exit(2)
    zoo.main()


if __name__ == "__main__":
    main()
