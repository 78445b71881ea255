"""Run the program `stiffopt` by ``python -m stiffopt``."""

from stiffopt.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
