"""Every Python block of the README and of docs/ runs, and their links lead somewhere.

The blocks of one page share their names, as a reader would type them in. Words after
`python` in the fence say what a block needs: `logs` (the recordings beside the
checkout) or `nightly` (too long for `make test`).
"""

import itertools
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]
FENCE = re.compile(r"^```python([^\n]*)\n(.*?)^```\s*$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)|(?:src|href)=\"([^\"#]+)\"")
COMMAND = re.compile(r"(?:^|`)make ([a-z]+)(?=`|\s*$|\s*#)", re.MULTILINE)
NEEDS = {"logs", "nightly"}


@dataclass(frozen=True)
class Block:
    """One fenced block: where it stands, what it says, what it needs."""

    page: Path
    line: int
    code: str
    needs: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        return f"{self.page.relative_to(ROOT).as_posix()}:{self.line}"


def blocks_of(page: Path) -> list[Block]:
    """The Python blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in FENCE.finditer(text):
        line = text.count("\n", 0, match.start(2)) + 1
        needs = frozenset(match[1].split())
        found.append(Block(page, line, match[2], needs))
    return found


def as_parameter(block: Block) -> Any:
    marks = [pytest.mark.nightly] if "nightly" in block.needs else []
    return pytest.param(block, id=block.name, marks=marks)


BLOCKS = [block for page in PAGES if page.is_file() for block in blocks_of(page)]


class Reader:
    """Someone who types in a page from the top; each block runs once.

    ``folder`` is where he stands: a block may go elsewhere, and he stays there.
    """

    def __init__(self, page: Path, folder: Path) -> None:
        self.waiting, self.folder = blocks_of(page), folder
        self.names: dict[str, object] = {"__name__": "__main__"}

    def read_to(self, block: Block) -> None:
        """Run what stands before the block and has not run yet, then the block."""
        os.chdir(self.folder)
        due = [b for b in self.waiting if b.line <= block.line]
        self.waiting = [b for b in self.waiting if b.line > block.line]
        for each in due:
            # Empty lines in front make a traceback name the page's own line.
            code = "\n" * (each.line - 1) + each.code
            exec(compile(code, str(each.page), "exec"), self.names)
        self.folder = Path.cwd()


Readers = dict[Path, Reader]


@pytest.fixture(scope="module")
def readers(tmp_path_factory: pytest.TempPathFactory) -> Readers:
    """A reader and an empty folder for each page; examples/ is at hand."""
    found = {}
    for page in {block.page for block in BLOCKS}:
        folder = tmp_path_factory.mktemp(page.stem)
        if (ROOT / "examples").is_dir():
            (folder / "examples").symlink_to(ROOT / "examples")
        found[page] = Reader(page, folder)
    return found


@pytest.mark.parametrize("block", [as_parameter(block) for block in BLOCKS])
def test_block_runs(
    block: Block,
    readers: Readers,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if "logs" in block.needs:
        request.getfixturevalue("shared_data")
    monkeypatch.chdir(ROOT)  # where the next test begins
    readers[block.page].read_to(block)


def test_blocks_ask_only_for_known_things() -> None:
    odd = [block.name for block in BLOCKS if not block.needs <= NEEDS]
    assert not odd, f"known words after ```python are {sorted(NEEDS)}"


def test_links_lead_somewhere() -> None:
    broken = []
    for page in PAGES + sorted(ROOT.glob("*.md")):
        for match in LINK.finditer(page.read_text(encoding="utf-8")):
            target = match[1] or match[2]
            if re.match(r"[a-z]+:", target):
                continue  # another site
            if not (page.parent / target).exists():
                broken.append(f"{page.relative_to(ROOT).as_posix()}: {target}")
    assert not broken, "\n".join(broken)


def test_make_targets_in_the_pages_exist() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.M))
    named = {
        name
        for page in {*PAGES, *ROOT.glob("*.md")}
        for name in COMMAND.findall(page.read_text(encoding="utf-8"))
    }
    assert named <= targets


def test_a_page_is_read_in_order_and_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = tmp_path / "page.md"
    fence = "```"
    texts = ["seen = [1]", "seen.append(2)", "seen.append(missing)"]
    page.write_text("".join(f"{fence}python\n{text}\n{fence}\n" for text in texts))
    first, second, third = blocks_of(page)
    reader = Reader(page, tmp_path)
    for block in itertools.chain([second], [first, second]):
        reader.read_to(block)
    assert reader.names["seen"] == [1, 2]
    with pytest.raises(NameError):
        reader.read_to(third)
