"""Which store and which machine the verbs mean by a machine file, or a directory of them."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING

import pytest
from support.given_codes import had
from support.machine_files import LAVAL
from support.written_journals import write_journal

from daqsvc.alarms.commands import AlarmCommand, CommandOutcome
from daqsvc.cli import main
from daqsvc.commands.status import _shown
from daqsvc.control import ControlServer
from daqsvc.outbox.machine_files import note_files

if TYPE_CHECKING:
    from pathlib import Path

    Captured = pytest.CaptureFixture[str]

RIG = LAVAL.read_text().partition("[mqtt]")[0]
STORE = '\n[store]\ndirectory = "store"\n'
BROKEN = RIG.replace("sampling", "sampeling") + "\n[what]\nis = 1\n"


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the stores of people are."""
    monkeypatch.setenv("XDG_STATE_HOME", f"{tmp_path / 'state'}")
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    return tmp_path / "state" / "daqsvc"


def machines(folder: Path, **more: str) -> Path:
    """A directory of machine files, each of one more machine."""
    folder.mkdir()
    for number, (name, text) in enumerate(more.items()):
        rig = RIG.replace('name = "laval-rig"', f'name = "{name}"').replace("0x101", f"{0x101 + number:#x}")
        (folder / f"{name}.toml").write_text(text if "what" in text else rig + text)
    return folder


def verb(capsys: Captured, *words: object) -> tuple[int, str, str]:
    code = main([f"{word}" for word in words])
    return code, *capsys.readouterr()


def alarms_of(capsys: Captured, *words: object) -> list[str]:
    code, out, err = verb(capsys, "alarms", "--json", *words)
    assert (code, err) == (0, "")
    return [json.loads(line)["machine"] for line in out.splitlines()]


class Service:
    """A service on a store, that takes what it is told and remembers it."""

    def __init__(self, store: Path, *watched: str) -> None:
        self.told: list[tuple[str | None, str]] = []
        self.server = ControlServer(store, watched, self._execute, status=self._status)
        self._watched = watched
        self.outcome = CommandOutcome(accepted=True)

    async def _execute(self, command: AlarmCommand, source: str) -> CommandOutcome:
        self.told.append((command.machine, command.alarm))
        return self.outcome

    async def _status(self, machine: str | None) -> bytes | tuple[str, ...]:
        if machine not in self._watched:
            return self._watched
        return json.dumps({"schema": "daqsvc.service-status/1", "machine": machine}).encode() + b"\n"

    async def asked(self, capsys: Captured, *words: object) -> tuple[int, str, str]:
        await self.server.open()
        try:
            return await asyncio.to_thread(verb, capsys, *words)
        finally:
            await self.server.close()


async def test_names_of_a_journal_do_nothing_to_a_terminal(tmp_path: Path, capsys: Captured) -> None:
    """It is root's, as a rule, and the journal another account's."""
    evil = "\x1b]0;owned\x07"
    same = {"occurrence": "0d8c1c4e"}
    await write_journal(
        tmp_path, *({"machine": evil, "alarm": f"{evil}{n}", "id": f"{n}"} | same for n in (1, 2))
    )
    for words, said in (
        (("alarms", "--machine", "pump"), "has alarms of"),
        (("ack", "0d8c"), "begins the ids of"),
    ):
        code, out, err = verb(capsys, *words, "--store", tmp_path)
        assert (code, out) == (1, "")
        assert said in err
        assert err.removesuffix("\n").isprintable()
    service = Service(tmp_path, "pump")
    service.outcome = CommandOutcome(accepted=True, reason=f"{evil} is full")
    code, out, _ = await service.asked(capsys, "ack", "any", "--store", tmp_path)
    assert (code, out) == (1, "any: \N{REPLACEMENT CHARACTER}]0;owned\N{REPLACEMENT CHARACTER} is full\n")


async def test_a_machine_that_is_none_of_the_store_is_refused(tmp_path: Path, capsys: Captured) -> None:
    """Or every alarm of it would be normal."""
    plant = machines(tmp_path / "plant", pump=STORE, fan=STORE)
    store = plant / "store"
    await write_journal(store, {"machine": "gone"}, {"machine": "pump"}, {"machine": "pump", "kind": "x"})
    for named, known in ((plant, "box, fan, gone, pump"), (plant / "pump.toml", "gone, pump")):
        code, out, err = verb(capsys, "alarms", "--machine", "pmup", named)
        assert (code, out) == (1, "")
        assert err == f"daqsvc alarms: the store {store} has alarms of {known}, not of pmup [C04]\n"
        had("C04", err)
    code, out, err = await Service(store, "new").asked(capsys, "alarms", "--store", store, "--machine", "new")
    assert (code, out) == (0, "every alarm is normal\n")
    assert (
        "has alarms of gone, pump, not of new"
        in verb(capsys, "alarms", "--store", store, "--machine", "new")[2]
    )
    assert alarms_of(capsys, "--machine", "fan", plant) == []
    assert alarms_of(capsys, "--machine", "gone", plant) == ["gone"]
    assert alarms_of(capsys, "--machine", "pump", "--history", 1, plant) == ["pump"]
    assert alarms_of(capsys, "--machine", "gone", "--history", 1, plant) == ["gone"]


def test_a_reload_is_of_all_machines(capsys: Captured) -> None:
    with pytest.raises(SystemExit):
        main(["reload", "--machine", "pump", "plant"])
    assert "unrecognized arguments: --machine" in capsys.readouterr().err


def test_a_reload_without_a_service_says_when_it_must_be_restarted(tmp_path: Path, capsys: Captured) -> None:
    plant = machines(tmp_path / "plant", pump=STORE)
    remedy = f"; if site, box or [store] of {plant} were changed, the service must be restarted"
    code, _, err = verb(capsys, "reload", plant)
    assert code == 1
    assert f"no daqsvc runs on the store {plant / 'store'}: " in err
    assert err.endswith(f"{remedy} [C06]\n")
    code, _, err = verb(capsys, "reload", "--store", plant / "store")
    assert code == 1
    assert "were changed" not in err


@pytest.mark.parametrize("table", ["", STORE])
async def test_a_file_of_a_box_means_its_machine_in_the_store_of_the_box(
    table: str, tmp_path: Path, state: Path, capsys: Captured
) -> None:
    plant = machines(tmp_path / "plant", pump="", fan=table)
    store = plant / "store" if table else state / "lab-edge-1"
    own = state / "lab-edge-1-pump"
    code, _, err = verb(capsys, "alarms", plant / "pump.toml")
    assert code == 1
    assert f"there is no journal {own}" in err
    await write_journal(store, {"machine": "pump"}, {"machine": "fan", "alarm": "hot"})
    assert alarms_of(capsys, plant / "pump.toml") == ["pump"]
    assert len(alarms_of(capsys, plant)) == 2
    service = Service(store, "pump", "fan")
    assert (await service.asked(capsys, "ack", "hot", plant / "pump.toml"))[0] == 0
    assert service.told == [("pump", "hot")]
    code, out, _ = await service.asked(capsys, "status", "--json", plant / "pump.toml")
    assert [json.loads(line)["machine"] for line in out.splitlines()] == ["pump"]
    (plant / "other.toml").write_text(RIG)
    code, _, err = verb(capsys, "alarms", plant / "other.toml")
    assert code == 1, "no service has ever watched it there"
    await write_journal(own, {"machine": "pump"}, {"machine": "pump", "alarm": "hot"})
    assert len(alarms_of(capsys, plant / "pump.toml")) == 2, "its own store goes first"


@pytest.mark.parametrize(
    ("files", "code"),
    [
        ({"pump": STORE, "fan": BROKEN}, 0),
        ({"pump": "", "fan": BROKEN}, 2),
        ({"pump": STORE, "fan": STORE.replace('store"', 'other"'), "mill": BROKEN}, 2),
        ({"pump": STORE, "fan": STORE.replace('store"', 'other"')}, 2),
        ({"fan": BROKEN}, 2),
    ],
)
async def test_verbs_go_on_by_the_sound_files_if_these_tell_one_store(
    files: dict[str, str], code: int, tmp_path: Path, capsys: Captured
) -> None:
    """As the service does, which refuses the files with errors and goes on."""
    plant = machines(tmp_path / "plant", **files)
    await write_journal(plant / "store", {"machine": "pump"})
    got, out, err = verb(capsys, "alarms", "--json", plant)
    assert got == code
    assert ("fan.toml" in err) == (BROKEN in files.values() and list(files)[-1] == "fan")
    assert out.count("\n") == (code == 0)
    assert (f"{plant}: the store is taken from the other machine files: {plant / 'store'} [C27]" in err) == (
        not code
    )
    if not code:
        had("C27", err)
    assert verb(capsys, "reload", plant)[0] == 2, "which is about all files"


async def test_sound_files_without_a_store_mean_the_default_one_where_it_is(
    tmp_path: Path, state: Path, capsys: Captured
) -> None:
    plant = machines(tmp_path / "plant", pump="", fan=BROKEN)
    await write_journal(state / "lab-edge-1", {"machine": "pump"})
    code, out, _ = verb(capsys, "alarms", "--json", plant)
    assert (code, out.count("\n")) == (0, 1)
    assert verb(capsys, "alarms", plant / "fan.toml")[0] == 2


async def test_a_file_with_a_store_of_its_own_means_its_machine_there_too(
    tmp_path: Path, capsys: Captured
) -> None:
    """Several files may each have the same [store]."""
    two = machines(tmp_path / "two", pump=STORE, fan=STORE)
    store = two / "store"
    await write_journal(store, {"machine": "pump", "alarm": "hot"}, {"machine": "fan", "alarm": "hot"})
    assert alarms_of(capsys, two / "fan.toml") == ["fan"]
    assert alarms_of(capsys, two / "fan.toml", "--machine", "pump") == ["pump"]
    service = Service(store, "pump", "fan")
    assert (await service.asked(capsys, "ack", "hot", two / "pump.toml"))[0] == 0
    assert (await service.asked(capsys, "ack", "hot", two))[0] == 0
    assert service.told == [("pump", "hot"), (None, "hot")]


async def test_a_broken_file_leaves_its_store_to_be_named(tmp_path: Path, capsys: Captured) -> None:
    """The service may run well by what the file was before."""
    (tmp_path / "rig.toml").write_text(BROKEN)
    for words in (["status"], ["ack", "hot"]):
        code, _, err = verb(capsys, *words, tmp_path / "rig.toml")
        assert code == 2
        assert err.endswith("\nor name the store with --store DIR\n")
    code, _, err = verb(capsys, "reload", tmp_path / "rig.toml")
    assert (code, "--store" in err) == (2, False), "that would not be accepted either"


@pytest.mark.parametrize("words", [["alarms"], ["status"], ["reload"], ["snapshot"], ["ack", "hot"]])
def test_a_store_that_is_a_file_is_said_in_a_sentence(
    words: list[str], tmp_path: Path, capsys: Captured
) -> None:
    (tmp_path / "file").touch()
    code, _, err = verb(capsys, *words, "--store", tmp_path / "file")
    assert code == 1
    assert err == (
        f"daqsvc {words[0]}: the store {tmp_path}/file is no directory, but a file: name a directory in "
        "[store] of the machine file, or with --store [C03]\n"
    )


def test_one_file_of_a_service_is_enough(capsys: Captured) -> None:
    for words in (["reload"], ["status"], ["ack", "hot"]):
        with pytest.raises(SystemExit) as ended:
            main([*words, "a.toml", "b.toml"])
        assert ended.value.code == 2
        said = "unrecognized arguments: b.toml: one file of the service is enough, or the directory of them"
        assert said in capsys.readouterr().err


def two_files(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Two files of the same machine's name, and the store that the service of the first one has."""
    first, second, store = tmp_path / "first.toml", tmp_path / "second.toml", tmp_path / "store"
    first.write_text(RIG + STORE)
    second.write_text(RIG.replace("0x101", "0x201") + STORE)
    store.mkdir(mode=0o700)
    note_files(store, {"laval-rig": first})
    return first, second, store


def test_the_picture_of_a_terminal_begins_with_the_warning_as_it_covers_what_was_printed() -> None:
    assert _shown([], as_json=False, is_live=True, warning="second.toml has ... [S02]") == (
        "second.toml has ... [S02]"
    )


@pytest.mark.parametrize("words", [("status", "--json"), ("alarms",), ("alarms", "--json")], ids=" ".join)
async def test_what_is_of_another_file_with_the_same_name_is_shown_with_a_warning(
    words: tuple[str, ...], tmp_path: Path, capsys: Captured
) -> None:
    first, second, store = two_files(tmp_path)
    await write_journal(store, {"machine": "laval-rig"})
    service = Service(store, "laval-rig")
    code, _, err = await service.asked(capsys, *words, second)
    assert code == 0
    assert err.startswith(f"daqsvc {words[0]}: {second} has the same site")
    assert f"as {first}, with which the service was started: values and alarms are those of {first}" in err
    had("S02", err.partition(": ")[2])
    assert (await service.asked(capsys, *words, first))[2] == ""


@pytest.mark.parametrize(
    "words",
    [
        ("ack", "probe-x"),
        ("reset", "probe-x"),
        ("shelve", "probe-x", "--for", "1h"),
        ("bypass", "probe-x"),
        ("snapshot",),
    ],
    ids=lambda words: words[0],
)
async def test_nothing_is_done_to_the_alarms_of_another_file_with_the_same_name(
    words: tuple[str, ...], tmp_path: Path, capsys: Captured
) -> None:
    first, second, store = two_files(tmp_path)
    await write_journal(store, {"machine": "laval-rig", "alarm": "probe-x"})
    service = Service(store, "laval-rig")
    code, _, err = await service.asked(capsys, *words, second)
    assert code == 1
    assert err.startswith(f"daqsvc {words[0]}: nothing was done: {second} has the same site")
    assert f"Remedy: name {first} if you mean them" in err
    had("S02", err.partition(": ")[2])
    assert service.told == []


async def test_a_copy_with_the_same_text_or_a_moved_file_is_the_same_machine(
    tmp_path: Path, capsys: Captured
) -> None:
    first, second, store = two_files(tmp_path)
    await write_journal(store, {"machine": "laval-rig", "alarm": "probe-x"})
    service = Service(store, "laval-rig")
    text = second.read_text()
    second.write_text(first.read_text())
    assert await service.asked(capsys, "ack", "probe-x", second) == (0, "probe-x: acknowledged\n", "")
    second.write_text(text)
    first.unlink()
    assert (await service.asked(capsys, "ack", "probe-x", second))[0] == 0
    assert service.told == [("laval-rig", "probe-x")] * 2
