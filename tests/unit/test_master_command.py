"""The guard's command line, before it starts a master; tests/ros has the rest."""

import pytest

from ros1_master_guard.command import main


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--log", "xml"], "--log: invalid choice: 'xml' (choose from"),
        (["--silent-s", "0.1"], "--silent-s: is '0.1'; allowed are numbers from 0.5 to 3600"),
        (["--port", "65536"], "--port: is '65536'; allowed are whole numbers from 1 to 65535"),
        (["--port", "ten"], "--port: is 'ten'; allowed are whole numbers"),
        (["--directory", ""], "--directory: is empty"),
        (["--rossout"], "unrecognized arguments: --rossout"),
    ],
)
def test_bad_options(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert message in said
    assert "ros1_master_guard: error: " in said
