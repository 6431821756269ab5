"""``daqsvc alarms`` over a journal whose messages have changed on the disk."""

from __future__ import annotations

from typing import TYPE_CHECKING

from support.given_codes import had
from support.written_journals import write_journal

from daqsvc.cli import main
from daqsvc.outbox.reading import JOURNAL_NAME

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


async def test_what_has_changed_on_the_disk_is_left_out_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    await write_journal(tmp_path, {"message": "it shakes"}, {"alarm": "hot", "message": "it is hot"})
    path = tmp_path / JOURNAL_NAME
    path.write_bytes(path.read_bytes().replace(b"it shakes", b"IT SHAKES"))
    assert main(["alarms", "--all", "--store", f"{tmp_path}"]) == 0
    out, err = capsys.readouterr()
    assert ("it is hot" in out, "SHAKES" in out) == (True, False)
    assert err.startswith(f"{tmp_path}: ")
    assert err.endswith("messages of the journal have changed on the disk and are left out [S07]\n")
    had("S07", err)
