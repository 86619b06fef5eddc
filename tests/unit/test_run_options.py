"""The options of ``holdfast run`` and the command that goes on."""

import shlex
from pathlib import Path

import pytest

from holdfast.cli.run_options import RunOptions
from holdfast.errors import OptionError


def test_the_command_that_goes_on_can_be_given() -> None:
    run = RunOptions.parse("run", ["--out=-o", "--", "-x.yaml"])
    words = shlex.split(run.resume_command(Path("-o")))[2:]
    again = RunOptions.parse("run", words)
    places = (Path("-x.yaml").absolute(), Path("-o").absolute())
    assert (again.configuration, again.out, again.resume) == (*places, True)


@pytest.mark.parametrize(("text", "shown"), [("ten", "'ten'"), ("t" * 90, f"'{'t' * 76}[.]{{3}}")])
def test_a_bad_address_is_named_once(text: str, shown: str) -> None:
    with pytest.raises(OptionError, match=f"^--health is {shown}: port {shown} is not a whole"):
        RunOptions.parse("run", ["x.yaml", "--health", text])
