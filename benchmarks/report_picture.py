"""The README's picture of a report: what `sim2gp identify` says of `sim2gp example`.

    python benchmarks/report_picture.py [--out docs/images/report.png]

Needs Chromium. The report is made in a temporary folder.
"""

import argparse
import io
import shutil
import subprocess
import tempfile
from pathlib import Path

from PIL import Image

import sim2gp as sg

WIDTH, HEIGHT = 960, 1000  # pixels: the first screen


def main() -> None:
    """Identify the example's arm and photograph its report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images/report.png"))
    out = parser.parse_args().out
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        raise SystemExit("Chromium is not on the PATH")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = sg.load_project(sg.example(folder / "first"))
        page = sg.identify(robot).save(folder / "arm") / "report.html"
        shot = folder / "shot.png"
        command = [
            browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            f"--user-data-dir={folder / 'browser'}", f"--screenshot={shot}",
            f"--window-size={WIDTH},{HEIGHT}", "--force-device-scale-factor=1.5",
            page.as_uri(),
        ]  # fmt: skip
        subprocess.run(command, check=True, capture_output=True, timeout=120)
        picture = Image.open(io.BytesIO(shot.read_bytes())).convert("RGB")
    picture.quantize(128).save(out, optimize=True)


if __name__ == "__main__":
    main()
