"""One table in the formats in which it is passed on."""

import csv
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from holdfast.errors import HoldfastError, OutputError
from holdfast.reports.table_formats import Table, outward, rounded


class Prices(Table):
    def columns(self) -> Sequence[str]:
        return ("what", "price")

    def rows(self) -> list[tuple[object, ...]]:
        return [("a|b, 5%_<", 0.1 + 0.2), ("=1+1", None)]

    def shown(self) -> list[tuple[str, ...]]:
        return [("", "price"), ("a|b, 5%_<", "0.3\n-1 [0, 5]*")]

    def legend(self) -> str:
        return "prices in <EUR>"


def test_formats(tmp_path: Path) -> None:
    table = Prices()
    markdown = table.to_markdown(tmp_path / "table.md")
    assert markdown.splitlines() == [
        "|           | price            |",
        "| --------- | ---------------- |",
        r"| a\|b, 5%_< | 0.3 (-1 [0, 5]*) |",
        "",
        "prices in <EUR>",
    ]
    assert (tmp_path / "table.md").read_text() == markdown
    assert table.to_latex().splitlines() == [
        r"{\footnotesize\begin{tabular}{lr}",
        r"\hline",
        r" & price \\",
        r"\hline",
        r"a|b, 5\%\_< & 0.3 \\",
        r" & $-$1 [0, 5]* \\",
        r"\hline",
        r"\end{tabular}",
        r"\par\smallskip prices in <EUR>",
        "}",
    ]
    # Numbers come back as they are, and no spreadsheet runs a text.
    assert list(csv.reader(table.to_csv().splitlines())) == [
        ["what", "price"],
        ["a|b, 5%_<", repr(0.1 + 0.2)],
        ["'=1+1", ""],
    ]
    assert repr(table).splitlines()[-1] == "prices in <EUR>"
    assert "<td>a|b, 5%_&lt;</td>" in table._repr_html_()
    assert "&lt;EUR&gt;" in table._repr_html_()
    frame = table.to_pandas()
    assert list(frame.columns) == ["what", "price"]
    assert frame["price"][0] == 0.1 + 0.2


def test_refusals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        Prices().to_csv(tmp_path / "missing" / "table.csv")
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(HoldfastError, match=r"to_pandas: pip install 'holdfast-sensing\[tune\]'"):
        Prices().to_pandas()


def test_values_are_rounded_away_from_zero_and_intervals_outward() -> None:
    assert [rounded(each, 0) for each in (42.5, 57.5, -42.5)] == [43.0, 58.0, -43.0]
    assert rounded(0.15, 1) == 0.2
    assert str(rounded(-0.3, 0)) == "0.0"
    assert outward((30.6, 54.4), 0) == (30.0, 55.0)
    assert outward((-0.3, 0.3), 1) == (-0.3, 0.3)  # bounds that have so many digits stay
