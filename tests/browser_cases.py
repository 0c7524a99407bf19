"""Run pages in a real browser, if one is installed."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
QUIET = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
)

SOFTWARE_WEBGL = (
    *(word for word in QUIET if word != "--disable-gpu"),
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--remote-debugging-port=0",
)

needs_browser = pytest.mark.skipif(
    BROWSER is None, reason=f"needs one of {', '.join(BROWSERS)} on the PATH"
)


def layout_on_a_phone(path: Path) -> str:
    """Return the layout at a phone's width."""
    return in_frame(path, "page.dataset.layout + ' ' + page.scrollWidth", width=390)


def in_frame(path: Path, expression: str, *, width: int) -> str:
    """Evaluate JavaScript on ``page``, in a frame, since a window has no width of a phone."""
    holder = path.parent / "frame.html"
    holder.write_text(
        f'<iframe id="shown" src="{path.name}" style="width:{width}px;height:800px;border:0">'
        "</iframe><script>setTimeout(() => { const page = shown.contentDocument.documentElement;"
        f"document.documentElement.dataset.found = {expression}; }}, 1500)</script>",
        encoding="utf-8",
    )
    html = browse(holder, "", "--allow-file-access-from-files", "--dump-dom")
    return attribute(html, "found")


def browse(path: Path, hash_: str, *arguments: str) -> str:
    command = [
        str(BROWSER),
        *QUIET,
        f"--user-data-dir={path.parent / 'profile'}",
        "--virtual-time-budget=3000",
        *arguments,
        path.as_uri() + hash_,
    ]
    done = subprocess.run(command, capture_output=True, timeout=120, check=True)
    return done.stdout.decode()


def dom(path: Path, hash_: str = "", size: str = "1280,900") -> str:
    return browse(path, hash_, f"--window-size={size}", "--dump-dom")


def attribute(html: str, name: str) -> str:
    return re.search(rf'<html[^>]* data-{name}="([^"]*)"', html).group(1)


def text_of(html: str, name: str) -> str:
    return re.search(rf'id="{name}"[^>]*>([^<]*)<', html).group(1)
