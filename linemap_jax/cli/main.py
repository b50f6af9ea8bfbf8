"""Reads the options, runs the command, and turns what goes wrong into one sentence."""

import difflib
import os
import sys
from typing import Annotated, get_args

import tyro

from linemap_jax.cli.build import Build, Demo
from linemap_jax.cli.calibrate import Calibrate
from linemap_jax.cli.compare import Compare
from linemap_jax.cli.config import Config
from linemap_jax.cli.evaluate import Evaluate
from linemap_jax.cli.export import Export
from linemap_jax.cli.extract import Extract
from linemap_jax.cli.info import Info
from linemap_jax.cli.localize import Localize
from linemap_jax.cli.merge import Merge
from linemap_jax.cli.numbers import NUMBERS
from linemap_jax.cli.options import UsageError
from linemap_jax.cli.simulate import Simulate
from linemap_jax.cli.slam import Slam
from linemap_jax.cli.trials import Trials
from linemap_jax.cli.verify import Verify

DESCRIPTION = """Maps of line segments and circles from 2D range scans, with covariances that can be believed.

Maps: demo, build, slam, localize, export, merge, compare.

Logs: info, extract, calibrate, config.

Laboratory: simulate, evaluate, trials, verify."""

Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Build, tyro.conf.subcommand("build")]
    | Annotated[Slam, tyro.conf.subcommand("slam")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Merge, tyro.conf.subcommand("merge")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Localize, tyro.conf.subcommand("localize")]
    | Annotated[Info, tyro.conf.subcommand("info")]
    | Annotated[Extract, tyro.conf.subcommand("extract")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Config, tyro.conf.subcommand("config")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Trials, tyro.conf.subcommand("trials")]
    | Annotated[Verify, tyro.conf.subcommand("verify")]
)
"""What can be run; each holds its options."""


NAMES = [get_args(kind)[1].name for kind in get_args(Command)]
"""Of the commands."""


def main(args: list[str] | None = None) -> int:
    """Run the command line.

    Args:
      args: the arguments; those of the process unless given.

    Returns:
      The exit status: 0; 1 if `verify` found a check that fails; 2 for bad input, about which one sentence has been
      printed; 130 for an interrupt.
    """
    args = sys.argv[1:] if args is None else args
    if args and (unknown := _unknown(args[0])):
        print(f"linemap: {unknown}", file=sys.stderr)
        return 2
    try:
        with NUMBERS:
            command = tyro.cli(
                Command,
                prog="linemap",
                description=DESCRIPTION,
                config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
                args=args,
            )
    except BrokenPipeError:
        return _nobody_reads()
    # What follows loads jax, which takes a second: not before the options are known to be right.
    from linemap_jax.io.atomic import OutputError
    from linemap_jax.io.config import ConfigError
    from linemap_jax.io.map_file import MapFileError
    from linemap_jax.io.reading import LogError
    from linemap_jax.io.table import TableError
    from linemap_jax.io.worlds import WorldFileError

    try:
        return command.run()
    except (LogError, OutputError, MapFileError, TableError, WorldFileError, ConfigError, UsageError) as error:
        print(f"linemap: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return _nobody_reads()
    except KeyboardInterrupt as interrupt:
        print("; ".join(["linemap: interrupted", *map(str, interrupt.args)]), file=sys.stderr)
        return 130


def _nobody_reads() -> int:
    """The exit status after whoever was reading has seen enough."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 1


def _unknown(word: str) -> str:
    """What is wrong with the word that should be a command; empty if it is one, or an option."""
    if word.startswith("-") or word in NAMES:
        return ""
    near = difflib.get_close_matches(word, NAMES, 1)
    return f"there is no command {word!r}; " + (f"did you mean {near[0]}?" if near else f"there are {', '.join(NAMES)}")
