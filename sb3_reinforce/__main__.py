"""The console script ``sb3-reinforce-zoo``, which is installed with and without the extra ``zoo`` that it needs."""

import sys


def main() -> None:
    """Run a command of ``sb3_reinforce.zoo``, or print what to install and exit with status 2."""
    try:
        from sb3_reinforce.zoo.__main__ import main as run
    except ImportError as error:
        print(f"sb3-reinforce-zoo: error: {error}", file=sys.stderr)
        sys.exit(2)
    run()


if __name__ == "__main__":
    main()
