"""The option `--version` of every command."""

import typer


def print_version(wanted: bool) -> None:
    """Print the version and exit, if that is wanted."""
    if wanted:
        from stiffopt import __version__

        typer.echo(f"stiffopt {__version__}")
        raise typer.Exit
