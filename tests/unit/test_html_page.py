"""A page of one file: what others have written in it stays text."""

import json
import re

import pytest

from holdfast.errors import OutputError
from holdfast.reports import html_page
from holdfast.reports.html_page import HtmlPage, chart_part

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\x1b[2J"


@pytest.fixture(autouse=True)
def _small_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(html_page, "_library", lambda: "let vegaEmbed;")


def test_no_text_becomes_a_part_of_the_page() -> None:
    page = HtmlPage(HOSTILE)
    page.section(HOSTILE)
    page.heading(HOSTILE)
    page.paragraph(HOSTILE)
    page.table([HOSTILE], [[HOSTILE, None]])
    page.code(HOSTILE, summary=HOSTILE)
    page.markdown(f"{HOSTILE}\n\n| a | b |\n| - | - |\n| {HOSTILE} | 1\\|2 |\n")
    page.picture(b"<svg/>", HOSTILE)
    page.chart(chart_part("trials", values=[{"outcome": HOSTILE}]))
    text = page.html().decode()
    assert text.count("<script>") == 2
    assert len(re.findall("<img ", text)) == 1
    assert "\x1b" not in text
    assert "<td>1|2</td>" in text
    found = re.search(r'id="charts">(.*?)</script>', text)
    assert found is not None
    assert json.loads(found[1])[0]["data"]["values"] == [{"outcome": HOSTILE}]


def test_a_page_is_bounded() -> None:
    page = HtmlPage("large")
    page.table(["n"], ([number] for number in range(500)))
    assert "The first 200 of 500 rows." in page.html().decode()
    page.code("x" * 3_000_000)
    with pytest.raises(OutputError, match="the limit is 3,000,000"):
        page.html()


def test_a_name_in_a_chart_is_any_value_and_within_a_text_a_word() -> None:
    part = chart_part("coordinate", i=3, height=70)
    assert part["height"] == 70
    assert part["layer"][1]["encoding"]["y"]["field"] == "m3"
