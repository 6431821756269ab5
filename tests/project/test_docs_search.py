"""The search box of the site: what users copy from the screen leads to its place in the reference."""

from __future__ import annotations

import random
import re
from typing import TYPE_CHECKING
from urllib.parse import quote

import pytest
from support.browsers import browsing
from support.docs_site import built_docs
from support.given_codes import messages as known_messages
from support.paths import ROOT

from daqsvc.errors.table import CODES
from daqsvc.reference.counters import NAME, figures

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

pytestmark = [pytest.mark.integration, pytest.mark.long, pytest.mark.sources]
GOLDEN = ROOT / "tests" / "guard" / "golden"
FIRST_THREE = "query => siteSearch(query).slice(0, 3).map(([page, , anchor]) => `${page}.html${anchor}`)"
BY_OTHERS = {"O17", "O25"}
"""Codes whose messages are put together far from where the code is named, or by a library."""
MESSAGE = re.compile(r"^! machines/(.+ \[([A-Z]\d\d)\])$", re.MULTILINE)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    return built_docs(tmp_path_factory)


async def searched(site: Path, queries: Sequence[str]) -> list[list[str]]:
    """The addresses of the first three results of each query, without a server: the site is read as files.

    The first query goes through the page, the others only through its script, which takes less time.
    """
    async with browsing() as browser:
        page = await (await browser.new_context()).new_page()
        wrong: list[str] = []
        page.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: wrong.append(f"{error}"))
        await page.goto(f"{(site / 'search.html').as_uri()}?q={quote(queries[0])}")
        await page.wait_for_function(
            "document.querySelector('#search-results h2').innerText == 'Search Results'"
        )
        links = await page.locator("#search-results li > a").all()
        shown = [f"{await link.get_attribute('href')}" for link in links[:3]]
        found: list[list[str]] = [await page.evaluate(FIRST_THREE, query) for query in queries]
        assert found[0] == shown
        assert wrong == []
    return found


async def test_letters_and_units_of_a_message_are_not_marked_in_other_words(site: Path) -> None:
    query = quote("no samples of stream 'device' for more than 2.0 s, 8.3 mm/s")
    async with browsing() as browser:
        page = await (await browser.new_context()).new_page()
        for place in (f"search.html?q={query}", "reference/errors.html"):
            await page.goto(f"{site.as_uri()}/{place}")
            await page.wait_for_selector("span.highlighted")
            marked = {text.lower() for text in await page.locator("span.highlighted").all_inner_texts()}
            assert "samples" in marked
            assert min(map(len, marked)) >= 3, marked


def messages() -> dict[str, str]:
    """Of 25 codes a message that ``daqsvc check`` shows, by the code."""
    texts = [file.read_text("utf-8") for file in sorted(GOLDEN.glob("broken-*.txt"))]
    shown = [found.groups() for text in texts for found in MESSAGE.finditer(text)]
    chance = random.Random(18)
    chance.shuffle(shown)
    by_code = {code: message for message, code in shown}
    return {code: by_code[code] for code in chance.sample(sorted(by_code), 25)}


async def test_a_counter_as_the_screen_shows_it_leads_to_its_row(site: Path) -> None:
    paths = ["streams.NAME.frames_set_aside", "buses.NAME.rx_overflows", "buses.NAME.frames_unknown"]
    paths += random.Random(18).sample([path for path in figures() if path not in paths], 10)
    shown = [path.replace(NAME, "fan-de") for path in paths]
    for path, found in zip(paths, await searched(site, shown), strict=True):
        assert found[0] == f"reference/counters.html#{path}"


async def test_a_message_leads_to_its_code(site: Path) -> None:
    by_code = messages()
    for code, found in zip(by_code, await searched(site, [*by_code.values()]), strict=True):
        assert found[0].startswith(f"reference/errors.html#{code.lower()}-"), by_code[code]


async def test_a_message_without_its_code_leads_to_the_errors(site: Path) -> None:
    by_code = messages()
    texts = [re.sub(r" \[\w+\]$", "", message) for message in by_code.values()]
    right = 0
    for (code, message), found in zip(by_code.items(), await searched(site, texts), strict=True):
        assert any(link.startswith("reference/errors.html#") for link in found), (message, found)
        right += any(link.startswith(f"reference/errors.html#{code.lower()}-") for link in found)
    assert right >= 22, right


async def test_a_message_that_a_test_has_had_leads_to_its_code(site: Path) -> None:
    """With the figures and names that it had then; its words alone, as daqsvc alarms printed them."""
    had = [(code, message) for code, those in known_messages().items() for message in those]
    had += [
        ("A17", "alarm vib-de raised: vib-de danger: value of vib-de is 8.301 mm/s, zone D of ISO 20816-3"),
        ("D22", "vib-de cannot be judged: the last 3 values of vib-de did not arrive, or are no numbers"),
        ("B37", "the device has restarted its counter, or has not counted for a while"),
    ]
    led = [
        any(link.startswith(f"reference/errors.html#{code.lower()}-") for link in found)
        for (code, _), found in zip(had, await searched(site, [message for _, message in had]), strict=True)
    ]
    assert all(led[-3:])
    missed = {code for (code, _), found in zip(had, led, strict=True) if not found}
    assert missed <= BY_OTHERS, missed


async def test_codes_subjects_keys_topics_and_metrics_lead_to_their_places(site: Path) -> None:
    first = {
        "F07": "reference/errors.html#f07-the-value-is-of-another-type",
        "pipeline.levels.window_s": "reference/keys-pipeline.html#pipeline-levels-window-s",
        "alarms[2].sensor": "reference/keys-alarms.html#alarms-sensor",
        "streams.fan.rate_hz": "reference/keys-streams.html#streams-name-rate-hz",
        "daqsvc_stream_faults_total": "reference/metrics.html#daqsvc_stream_faults_total",
        "daqsvc/plant/box1/status": "reference/topics.html#status",
        "daqsvc trend --since": "reference/verbs.html#daqsvc-trend--since",
        "calibrate": "calibration.html",
        "snapshot": "recorder.html",
    }
    for where, found in zip(first.values(), await searched(site, [*first]), strict=True):
        assert where in found, found


async def test_codes_lead_to_the_errors_before_what_has_been_changed_or_decided(site: Path) -> None:
    codes = [*CODES][::10]
    for code, found in zip(codes, await searched(site, codes), strict=True):
        assert found[0].startswith(f"reference/errors.html#{code.lower()}-")
