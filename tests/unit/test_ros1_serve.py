"""``holdfast ros1-serve`` as a command among the others; test_ros1_process.py has the rest."""

from tests.command_line import Workplace


def test_it_has_the_options_of_serve(workplace: Workplace) -> None:
    said = workplace.runs("ros1-serve", "--help")
    assert "--listen ENDPOINT" in said.stdout
    assert "--ros1-name NAME" in said.stdout
