"""Debian's Chromium, headless: what it says, whom it asks, what it shows."""

import json
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

_NAMES = ("chromium", "chromium-browser", "google-chrome")
QUIET_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--host-resolver-rules=MAP * ~NOTFOUND",  # nor does the browser ask anybody
)
_FLAGS = (*QUIET_FLAGS, "--enable-logging=stderr", "--v=0")


def find_chromium():
    """Path of a Chromium, or None; the variable SLAMGYM_CHROMIUM goes before."""
    named = os.environ.get("SLAMGYM_CHROMIUM")
    return named or next(filter(None, map(shutil.which, _NAMES)), None)


def run_chromium(page, *flags):
    """Open a page, and return standard output and the messages of its console."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [find_chromium(), *_FLAGS, f"--user-data-dir={profile}", *flags]
        done = subprocess.run(
            [*command, Path(page).as_uri()],
            capture_output=True,
            text=True,
            encoding="utf-8",
            timeout=120,
            check=True,
        )
    return done.stdout, re.findall(r"CONSOLE[:(].*", done.stderr)


def screenshot(page, path, *, size, dark=False):
    """Save what the page looks like, in the colours that its reader prefers."""
    run_chromium(
        page,
        f"--screenshot={path}",
        f"--window-size={size[0]},{size[1]}",
        f"--blink-settings=preferredColorScheme={0 if dark else 1}",
    )


def requests_of(page, folder):
    """Addresses that a page asks for, by Chromium's log of its network.

    What the browser asks on its own account has no page for its origin.
    """
    log = folder / "network.json"
    run_chromium(page, "--dump-dom", f"--log-net-log={log}")
    told = json.loads(log.read_text(encoding="utf-8"))
    begun = told["constants"]["logEventTypes"]["URL_REQUEST_START_JOB"]
    jobs = [
        event["params"]
        for event in told["events"]
        if event["type"] == begun and "url" in event.get("params", {})
    ]
    return [job["url"] for job in jobs if job["initiator"] != "not an origin"]
