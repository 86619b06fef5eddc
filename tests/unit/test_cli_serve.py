"""``holdfast serve`` brings ROS to the service; processes/test_service_process.py has the rest."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.command_line import run_here

from holdfast.cli.serve import _make_extensions
from holdfast.errors import ConfigurationError
from holdfast.service.options import parse_options


def test_a_bad_option_ends_before_anything_starts(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    said = run_here(capsys, tmp_path, "serve", "--wokers", "2")
    assert (said.code, said.stdout) == (2, "")
    assert "'--wokers' is no option of holdfast serve; did you mean --workers?" in said.stderr


def test_the_services_of_ros_read_their_configuration(tmp_path: Path) -> None:
    options = parse_options(["--ros1", "--configuration", str(tmp_path / "none.yaml")])
    with pytest.raises(ConfigurationError, match="there is no such file"):
        _make_extensions(options)
