"""The command line: all commands under ``placerec``."""

from __future__ import annotations

import typer

from service.commands.bench import bench
from service.commands.calibrate import calibrate
from service.commands.console import Commands
from service.commands.enrol import enrol
from service.commands.jobs import jobs
from service.commands.keys import keys
from service.commands.laboratory import add_laboratory
from service.commands.maps.backup import backup
from service.commands.maps.maps import maps
from service.commands.query import query
from service.commands.serve import serve
from service.commands.settings import settings

application = typer.Typer(
    cls=Commands,
    help="Visual place recognition: a camera frame goes in, the place comes out, or an honest 'unknown'.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (serve, enrol, query, calibrate, bench, settings):
    application.command()(command)
application.command("enroll", hidden=True)(enrol)  # as it is spelt in the United States
application.add_typer(maps, name="maps")
application.add_typer(backup, name="backup")
application.add_typer(jobs, name="jobs")
application.add_typer(keys, name="keys")
add_laboratory(application)
