"""The search box of the site: what users copy from the screen leads to its place in the reference."""

from __future__ import annotations

import random
import re
import tomllib
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
QUESTIONS = ROOT / "docs" / "search_questions.toml"
FIRST_THREE = "query => siteSearch(query).slice(0, 3).map(([page, , anchor]) => `${page}.html${anchor}`)"
BY_OTHERS = {"B28", "O10", "O11", "O17", "O25", "S05"}
"""Codes whose messages are put together far from where the code is named, or by a library."""
MESSAGE = re.compile(r"^! machines/(.+ \[([A-Z]\d\d)\])$", re.MULTILINE)

PLAIN = {
    "alarm comes and goes all the time": "alarms.html#alarms-that-come-and-go",
    "how to stop an alarm for one hour": "commands.html#commands",
    "how do I see last week": "history.html",
    "update software": "install.html#upgrade",
    "stop the service": "edge-box.html",
    "usb stick copy data": "export.html",
    "forgot to calibrate": "calibration.html",
    "natural frequency unknown": "calibration.html tutorials/07-calibrate",
    "time out slow device": "modbus.html#silent-units",
    "device closes connection": "modbus.html#errors-that-you-may-meet",
    "clock of the box is wrong": "alarms.html#clocks-and-restarts",
    "exception 3": "modbus.html#errors-that-you-may-meet reference/errors.html#b33-",
    "illegal data value": "reference/errors.html#b33-",
    "function 4 for register 1 is set aside": "reference/errors.html#b32-",
    "unit mm/sec": "reference/errors.html#a14-",
    "value table": "alarms.html#a-state-or-an-enum-signal",
    "bit rate": "reference/keys-buses.html#buses-name-bitrate",
    "baud rate": "reference/keys-buses.html#buses-name-baud",
    "bearing number": "bearing.html#catalogue",
    "sensor_ok": "alarms.html#alarms-that-daqsvc-adds",
    "slow device": "modbus.html#silent-units",
    "false alarm too many": "alarms.html#alarms-that-come-and-go",
    "which files to back up": "install.html#upgrade",
    "counter that wraps at 999": "serial.html#lines-of-text",
    "alarm comes and goes": "alarms.html#alarms-that-come-and-go",
    "my alarm keeps toggling": "alarms.html#alarms-that-come-and-go",
    "alarm raised again and again": "alarms.html#alarms-that-come-and-go",
    "nuisance alarms": "alarms.html#alarms-that-come-and-go",
    "mute alarm": "commands.html#commands tutorials/02-handle",
    "pause alarm during maintenance": "commands.html#commands tutorials/02-handle",
    "see data of last month": "history.html",
    "trend of yesterday": "history.html",
    "how do I upgrade": "install.html#upgrade",
    "restart service": "edge-box.html",
    "start service at boot": "edge-box.html",
    "backup": "install.html",
    "save data to usb": "export.html",
    "open samples in excel": "export.html",
    "modbus exception code 2": "modbus.html#errors-that-you-may-meet reference/errors.html#b33-",
    "slave does not answer": "modbus.html#silent-units",
    "parity": "serial.html#the-port reference/keys-buses.html#buses-name-parity",
    "CAN speed 500 kbit": "can.html#the-bus reference/keys-buses.html#buses-name-bitrate",
    "send mail": "outputs.html tutorials/08-broker",
    "status word alarm": "alarms.html#a-state-or-an-enum-signal",
    "system time wrong": "alarms.html#clocks-and-restarts",
    "user password page": "page.html#who-may-look",
    "no baseline yet": "calibration.html",
    "raw waveform of an alarm": "recorder.html",
    "scada": "sparkplug.html",
    "disk full": "outbox.html#when-the-disk-is-full",
    "wrong byte order": "can.html#if-no-frames serial.html#if-no-bytes modbus.html",
    "29 bit id": "reference/keys-streams.html#streams-name-layout-extended",
    "multiplexed signal": "can.html#the-frames",
    "temperature limit": "tutorials/0",
    "shelve": "tutorials/02-handle reference/verbs.html#daqsvc-shelve commands",
    "connect to scada": "sparkplug.html",
    "prometheus": "reference/metrics.html",
    "several machines one box": "several-machines.html",
    "change alarm limit while running": "edge-box.html#reload",
    "permission denied /dev/ttyUSB0": "serial.html#the-port",
    "send email when alarm": "outputs.html tutorials/08-broker",
    "acknowledge from phone": "page.html#who-may-look",
    "python program read values": "commands.html#programs",
    "grafana": "status.html#metrics-for-prometheus",
    "where are the files stored": "install.html#the-package edge-box.html#account",
    "chattering alarm": "alarms.html#alarms-that-come-and-go",
    "what is a deadband": "reference/keys-alarms.html#alarms-deadband",
    "status bit": "alarms.html#a-state-or-an-enum-signal",
    "word swap": "modbus.html",
    "sensor cable broken": "reference/errors.html",
    "max_count": "reference/keys-streams.html#streams-name-layout-max-count",
    "password of the broker": "mqtt.html#credentials",
    "sampling rate too low": "reference/errors.html#f34-",
    "device sends too slow": "modbus.html#silent-units serial.html#if-no-bytes",
    "extended id": "reference/keys-streams.html#streams-name-layout-extended",
    "frames_unknown": "reference/counters.html#buses.NAME.frames_unknown",
    "bits = [lowest, count]": "reference/keys-streams.html#streams-name-layout-channels-bits",
    "max_gap": "reference/keys-streams.html#streams-name-layout-max-gap",
    "velocity_rms": "reference/keys-alarms.html#alarms-measure",
    "temperature sensor PT100": "tutorials/0",
    "which fields has the json of trend": "reference/formats.html",
    "json schema of the control socket": "reference/formats.html",
    "audit.jsonl format": "reference/formats.html",
    "what means quality not_ok": "reference/payloads.html",
    "alarm shelve time": "commands.html tutorials/02-handle",
    "shaft speed changes": "order-change.html calibration.html",
    "daqsvc command not found": "install.html#from-a-clone",
    "what does first out mean": "glossary.html#first-out",
    "what are nats": "glossary.html#nat",
    "cover of an alarm": "glossary.html#cover alarms.html#states",
    "meaning of set aside": "glossary.html#set-aside driver-contract.html#streams-that-are-set-aside",
    "what is a keyphasor": "glossary.html#keyphasor",
    "mqtt login": "mqtt.html#credentials",
    "service does not start": "edge-box.html",
    "sensor unplugged": "alarms.html#alarms-that-daqsvc-adds",
    "install without internet": "install.html#the-package",
    "multiplexed CAN message": "can.html#the-frames",
    "multiplexed frame": "can.html#the-frames",
    "enum state alarm": "alarms.html#a-state-or-an-enum-signal",
    "no register could be read by function 3 and 4; registers 44001 to 44009 were asked": (
        "reference/errors.html#c20-"
    ),
    "counter c1 is 1.3, no whole number from 0 up": "reference/errors.html#b34-",
    "CAN bus 'can0' is lost: unixbus /run/can0 is gone: its hub ended": "reference/errors.html#b29-",
    "argument --store: not allowed with argument FILE": "reference/errors.html#c01-",
    '"-4" is not a rate': "reference/errors.html#c22-",
    "no alarm is named 'vibde'": "reference/errors.html#c05-",
    "more than 4 times as many frames come as the file states": "reference/errors.html#b38-",
    "is it the file of this device?": "sniff.html#can",
    "SensorState is left out: its values have names": "sniff.html#can alarms.html#a-state-or-an-enum-signal",
    "two devices same CAN id": "can.html#if-no-frames",
    "accelerometer in mg": "can.html#the-frames reference/keys-sensors",
    "not available 0xFFFF J1939": "can.html#the-frames",
    "rx_errors": "reference/counters.html#buses.NAME.rx_errors",
    "frames_malformed": "reference/counters.html#buses.NAME.frames_malformed",
    "samples_lost": "reference/counters.html#streams.NAME.samples_lost",
}
"""What engineers ask in plain words, and how the addresses begin of which one must be among the first three.

Some are in docs/search_questions.toml as they are here, some in other words, and some are not there at all.
"""


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


async def test_a_question_in_plain_words_leads_to_its_page(site: Path) -> None:
    wrong = {
        query: found
        for (query, wanted), found in zip(PLAIN.items(), await searched(site, [*PLAIN]), strict=True)
        if not any(link.startswith(tuple(wanted.split())) for link in found)
    }
    assert wrong == {}


async def test_the_list_of_questions_is_not_all_that_is_asked_here() -> None:
    kept = {question for those in tomllib.loads(QUESTIONS.read_text("utf-8")).values() for question in those}
    assert len({*PLAIN} - kept) > len(PLAIN) / 2


async def test_a_counter_and_a_topic_by_its_name_alone_come_first(site: Path) -> None:
    first = {
        "frames_unknown": "reference/counters.html#buses.NAME.frames_unknown",
        "rx_errors": "reference/counters.html#buses.NAME.rx_errors",
        "frames_malformed": "reference/counters.html#buses.NAME.frames_malformed",
        "ROOT/SITE/BOX/MACHINE/summary": "reference/topics.html#summary",
        "max_gap": "reference/keys-streams.html#streams-name-layout-max-gap",
    }
    found = await searched(site, [*first])
    assert dict(zip(first, (those[0] for those in found), strict=True)) == first


async def test_the_page_states_how_many_results_there_are(site: Path) -> None:
    async with browsing() as browser:
        page = await (await browser.new_context()).new_page()

        async def stated(query: str) -> str:
            await page.goto(f"{(site / 'search.html').as_uri()}?q={quote(query)}")
            await page.wait_for_function(
                "document.querySelector('#search-results h2').innerText == 'Search Results'"
            )
            return await page.locator("#search-results .search-summary").inner_text()

        said = await stated("alarm of a sensor")
        count = await page.evaluate("siteSearch('alarm of a sensor').length")
        assert count > 40
        assert said == f"{count} results; the best 40 are shown."
        assert await stated("frames_set_aside") != said
        assert await stated("xyzzyx") == "Nothing found. Try fewer words, or other ones."


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
    # Those about a machine file name keys and values of that file, and daqsvc check prints their codes.
    had = [
        (code, message)
        for code, those in known_messages().items()
        for message in those
        if not re.match(r"[\w-]+\.toml\b", message)
    ]
    had += [
        ("A17", "alarm vib-de raised: vib-de danger: value of vib-de is 8.301 mm/s, zone D of ISO 20816-3"),
        ("D22", "oil cannot be judged: the last 3 values of oil did not arrive, or the device had none"),
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
