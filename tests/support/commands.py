"""Commands of slamgym in this process."""

from typer.testing import CliRunner

from slamgym.experiments.command_line.app import main


def slamgym(*arguments):
    """Run a command; return its exit code and what it writes."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])
