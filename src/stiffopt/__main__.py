"""``python -m stiffopt``: the program `stiffopt`."""

from stiffopt.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
