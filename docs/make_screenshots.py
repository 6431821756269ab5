"""Make docs/page-orbit.png and docs/page-machine.png: the page of the demo, in Chromium.

    .venv/bin/python docs/make_screenshots.py

Needs Chromium (apt-get install chromium), and the extras of development. Each picture has its words
with it, so that a test can tell whether the page is still the same.
"""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
from pathlib import Path
from threading import Thread

from PIL import Image
from PIL.PngImagePlugin import PngInfo
from playwright.sync_api import Page, Playwright, sync_playwright

DOCS = Path(__file__).parent
WIDTH = 1100
SHOTS = {"page-orbit.png": ("light", "/orbit", 820), "page-machine.png": ("dark", "", 1290)}
"""By file, the colours, the view and the height."""
SETTLE_MS = 1500
WORDS = "Words"
"""Under which name a picture has its words."""
ON_THE_PICTURE = """() => {
    const words = [], texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    for (let text = texts.nextNode(); text; text = texts.nextNode()) {
        const range = document.createRange();
        range.selectNodeContents(text);
        const { width, top } = range.getBoundingClientRect();
        if (width && top < innerHeight && text.parentElement.checkVisibility()) words.push(text.data.trim());
    }
    return words.join("\\n");
}"""


def main(folder: Path = DOCS) -> None:
    """Play the demo until the shaft rubs, and take the pictures then."""
    command = [sys.executable, "-m", "daqsvc", "demo", "--page", "--again", "--json"]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as demo,  # noqa: S603 - of this checkout
        sync_playwright() as playwright,
    ):
        try:
            take(demo, playwright, folder)
        finally:
            demo.terminate()


def take(demo: subprocess.Popen[str], playwright: Playwright, folder: Path) -> None:
    """Take the pictures into a folder when the shaft rubs, by what the demo prints."""
    assert demo.stdout is not None  # noqa: S101 - a pipe was asked for
    address = json.loads(demo.stdout.readline())["address"].rstrip("/")
    browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
    pages = {
        name: browser.new_page(color_scheme=scheme, viewport={"width": WIDTH, "height": height})
        for name, (scheme, _, height) in SHOTS.items()
    }
    has_begun = False
    for line in demo.stdout:
        told = json.loads(line)
        if told["type"] == "diagnosis" and not has_begun:
            has_begun = True
            for name, (_, view, _) in SHOTS.items():
                pages[name].goto(f"{address}/machines/laval-rig{view}")
        if told["type"] == "alarm" and told["kind"] == "escalated":
            break
    Thread(target=demo.stdout.read, daemon=True).start()  # else it would wait for its reader
    for name, page in pages.items():
        page.wait_for_timeout(SETTLE_MS)
        save(page, folder / name)
    browser.close()


def save(page: Page, file: Path) -> None:
    """Save the picture of a page, and the words on it."""
    words = PngInfo()
    words.add_itxt(WORDS, page.evaluate(ON_THE_PICTURE))
    with Image.open(io.BytesIO(page.screenshot())) as picture:
        picture.save(file, pnginfo=words, optimize=True)


if __name__ == "__main__":
    main()
