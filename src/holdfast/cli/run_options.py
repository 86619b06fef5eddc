"""The options of ``holdfast run``, and the configuration that they lead to."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from holdfast.cli.overrides import Override, combined, overrides_of
from holdfast.errors import InvalidValueError
from holdfast.reports.view_target import ViewTarget, viewer_url
from holdfast.runtime import command_line
from holdfast.runtime.files import shown_path
from holdfast.runtime.log_lines import LogFormat
from holdfast.runtime.logs import log_option
from holdfast.runtime.watchdog import watchdog_option
from holdfast.service.options import http_address

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration
    from holdfast.runtime.monitoring import HttpAddress


_MIN_RATE_HZ = 0.001
_MAX_RATE_HZ = 10_000.0


def viewer(text: str) -> str:
    """Read ``rerun`` or ``rerun=HOST:PORT``."""
    name, equals, place = text.partition("=")
    if name == "rerun":
        with contextlib.suppress(InvalidValueError):
            if equals:
                viewer_url(place)
            return text
    raise command_line.bad_value(text, "rerun, or rerun=HOST:PORT of a viewer that runs elsewhere")


class RunOptions(command_line.Options):
    """Run the trials of CONFIG and write their results into a directory.

    DIR gets trials.csv (a row for each trial), summary.json, config.yaml (with all defaults filled
    in; it can be run again), journal.bin (every decision of every trial) and trial.png (a figure
    of trial 0).

    With --service, --environment, --rate or --view the trials are run one after another, as a robot
    does: every step is in the journal before it is performed, and DIR gets events.jsonl (what
    happened to the services) and timings.csv (how long each decision took) as well.

    Ctrl-C or a crash loses no trial and no step: the same command with --resume goes on.
    """

    exit_codes: ClassVar = {3: None, 4: None, 5: None}
    needs_arguments = True

    configuration: Path = command_line.argument(
        "CONFIG", "Configuration file (YAML) of the run.", command_line.location
    )
    trials: int | None = command_line.option(
        metavar="N",
        read=command_line.whole_number(1, command_line.MAX_TRIALS),
        key="simulator.num_trials",
        help="Number of trials, instead of the file's.",
    )
    seed: int | None = command_line.seed_option()
    problem: str | None = command_line.problem_option()
    problem_directory: Path | None = command_line.module_option()
    assignments: tuple[str, ...] = command_line.set_option("selector.method=random")
    jobs: int | None = command_line.jobs_option()
    out: Path | None = command_line.out_option("CONFIG-seedS")
    resume: bool = command_line.flag(
        help="Go on with the run in DIR (default: the latest) and run the missing trials; with a "
        "larger --trials, more than it had."
    )
    resume_if_begun: bool = command_line.flag(
        help="Go on with the run in DIR if it has begun, otherwise begin it; needs --out. For a "
        "unit or container that repeats one command."
    )
    after_reboot: bool = command_line.flag(
        help="Let the robot go on although the machine was rebooted since it last moved; without "
        "this, a run that is resumed then ends with code 5."
    )
    restart: bool = command_line.flag(
        help="Start the run again when its process dies or fails, but not after the codes 0, 3 and "
        "5 and a signal that ends it in order; needs --resume-if-begun. For a container, which the "
        "engine must not restart."
    )
    quiet: bool = command_line.flag(
        "-q", help="Show no progress and no summary: only errors. The files are the same."
    )
    service: tuple[str, ...] = command_line.option(
        "-s",
        metavar="ENDPOINT",
        many=True,
        key="offload.services",
        help="Let the service at ENDPOINT decide (tcp/10.0.0.7:7447); several are tried in this "
        "order.",
    )
    recovery: str | None = command_line.option(
        metavar="WHEN",
        key="recovery.launch",
        help="When to launch the local service: on_failure (the default), at_start or never.",
    )
    tls: Path | None = command_line.option(
        metavar="DIR",
        read=command_line.location,
        key="offload.tls",
        help="This robot's credentials, as holdfast keys makes them.",
    )
    environment: str | None = command_line.option(
        "-e",
        metavar="MODULE:CLASS",
        key="environment.object",
        help="Act on this environment instead of a simulated one.",
    )
    rate: float | None = command_line.option(
        metavar="HZ",
        read=command_line.number(_MIN_RATE_HZ, _MAX_RATE_HZ, "Hz"),
        help="Task actions a second (default: as fast as possible).",
    )
    health: HttpAddress | None = command_line.option(
        metavar="HOST:PORT",
        read=http_address,
        help="Answer http://HOST:PORT/livez, and /readyz while a service or the robot itself "
        "decides; a PORT alone is one of 127.0.0.1.",
    )
    metrics: HttpAddress | None = command_line.option(
        metavar="HOST:PORT",
        read=http_address,
        help="Offer this robot's metrics for Prometheus at http://HOST:PORT/metrics. The address "
        "may be that of --health.",
    )
    view: str | None = command_line.option(
        metavar="rerun",
        read=viewer,
        help="Show the run in Rerun's viewer while it goes on (extra view); rerun=HOST:PORT is one "
        "that runs elsewhere.",
    )
    view_file: Path | None = command_line.option(
        metavar="FILE",
        read=command_line.location,
        help="Write what is shown to FILE (.rrd), with --view or without it.",
    )
    log: LogFormat = log_option("Format of the events shown: text or json.")
    watchdog_s: float | None = watchdog_option(None, " (default: never; with --restart 20)")

    def view_target(self) -> ViewTarget | None:
        """Return where to show the run while it goes on, if anywhere."""
        if self.view is None and self.view_file is None:
            return None
        url = None
        if self.view is not None:
            place = self.view.partition("=")[2]
            url = viewer_url(place) if place else ""
        return ViewTarget(url, None if self.view_file is None else str(self.view_file))

    def resume_command(self, directory: Path) -> str:
        """Return the command that goes on."""
        return self.command_to_resume(
            "run",
            directory,
            *("resume_if_begun", "after_reboot", "restart", "watchdog_s", "quiet", "view_file"),
        )

    def overrides(self) -> list[Override]:
        """Return the values that replace those of the file."""
        return overrides_of(self, self.assignments)

    def load(self) -> Configuration:
        """Read the configuration, with the values that replace those of the file."""
        from holdfast.config.loader import load

        path = shown_path(self.configuration)  # as messages name it
        return load(path, problem=self.problem, overrides=combined(self.overrides()))
