"""The pages of docs/ as the site generator wants them, and a reference of the package.

    python docs/site/stage.py build/docs/pages

The pages are plain Markdown that reads as it is; three things are said differently for
the site. A fence ```` ```python nightly ```` loses what the tests say to themselves (so
does that of a part of a project file, which names the system that completes it); a
link that leaves docs/ takes its target along, since a site is one folder; and what
README calls the tree is the reference. That has a page for each package of sim2gp, and
one for the modules next to them, so that a new module is in it without being entered.

Notebooks of examples/ become pages, with a file for Jupyter and Colab next to each.
"""

import ast
import json
import re
import shutil
import sys
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "sim2gp"
#: Pages of the root that are pages of the site.
TOP = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
#: Modules next to the packages share a page.
CORE = "core"
DEFINITIONS = (ast.ClassDef, ast.FunctionDef)

FENCE = re.compile(r"^```(python|toml)[^\n]*$", re.MULTILINE)
LINK = re.compile(r"(?<=\]\()([^)#\s]+)")
CODE = re.compile(r"^```.*?^```\s*?$|`[^`\n]+`", re.MULTILINE | re.DOTALL)


def main(out: Path) -> None:
    """Write every page of the site below ``out``, which is emptied first."""
    shutil.rmtree(out, ignore_errors=True)
    (out / "reference").mkdir(parents=True)
    for page in sorted((ROOT / "docs").glob("*.md")):
        (out / page.name).write_text(staged(page, out), encoding="utf-8")
    for file in sorted((ROOT / "examples").glob("*.py")):
        text = file.read_text(encoding="utf-8")
        page = relinked_code(as_page(text), file, out)
        name = f"{file.stem}.ipynb"
        page += f"\nThis page as a notebook, for Jupyter and Colab: [{name}]({name}).\n"
        (out / f"example_{file.stem}.md").write_text(page, encoding="utf-8")
        (out / f"{file.stem}.ipynb").write_text(as_notebook(text), encoding="utf-8")
    for name, target in TOP.items():
        (out / target).write_text(staged(ROOT / name, out), encoding="utf-8")
    (out / "assets").mkdir()
    for name in ("iframe-worker.js", "site.css"):
        shutil.copy(Path(__file__).with_name(name), out / "assets" / name)
    for name, text in reference().items():
        (out / "reference" / f"{name}.md").write_text(text, encoding="utf-8")


def staged(page: Path, out: Path) -> str:
    """The text of a page of the repository as a page of the site."""
    return relinked_code(page.read_text(encoding="utf-8"), page, out)


def relinked_code(text: str, page: Path, out: Path) -> str:
    """The text of a page with links of the site, and plain fences."""
    text = FENCE.sub(r"```\1", text)
    # Code keeps its brackets: a link is looked for between the pieces of code alone.
    pieces, end = [], 0
    for code in CODE.finditer(text):
        pieces += [relinked(text[end : code.start()], page, out), code[0]]
        end = code.end()
    return "".join([*pieces, relinked(text[end:], page, out)])


def cells(text: str) -> list[tuple[str, str]]:
    """The cells of a notebook in py:percent form: their kind and their text."""
    found = []
    for part in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        head, _, body = part.partition("\n")
        if "[markdown]" in head:
            lines = [
                line.removeprefix("#").removeprefix(" ") for line in body.split("\n")
            ]
            found.append(("markdown", "\n".join(lines).strip()))
        else:
            found.append(("code", body.strip()))
    return found


def as_page(text: str) -> str:
    """A notebook as a page."""
    parts = [
        body if kind == "markdown" else f"```python\n{body}\n```"
        for kind, body in cells(text)
    ]
    return "\n\n".join(parts) + "\n"


def as_notebook(text: str) -> str:
    """A notebook as Jupyter and Colab read it (nbformat 4.5)."""
    made = []
    for number, (kind, body) in enumerate(cells(text)):
        cell: dict[str, object] = {"cell_type": kind, "id": f"cell{number}"}
        cell |= {"metadata": {}, "source": body.splitlines(keepends=True)}
        if kind == "code":
            cell |= {"execution_count": None, "outputs": []}
        made.append(cell)
    spec = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return json.dumps(
        {
            "nbformat": 4,
            "nbformat_minor": 5,
            "metadata": {"kernelspec": spec},
            "cells": made,
        },
        indent=1,
    )


def relinked(text: str, page: Path, out: Path) -> str:
    """The text with each link to a file of the repository as one of the site."""
    return LINK.sub(lambda found: _target(found[1], page, out), text)


def _target(link: str, page: Path, out: Path) -> str:
    """Where a link of the repository leads on the site; files are copied along."""
    if re.match(r"[a-z]+:", link):
        return link  # another site
    file = (page.parent / link).resolve()
    where = file.relative_to(ROOT)
    if where.parent == Path("docs") and file.suffix == ".md":
        return file.name
    if where.as_posix() in TOP:
        return TOP[where.as_posix()]
    if where.as_posix() == "README.md":
        return "reference/index.md"  # whose second heading is README's, the tree
    copy = out / "files" / where
    copy.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(file, copy)
    return f"files/{where.as_posix()}"


def modules() -> dict[str, list[str]]:
    """Every module of sim2gp by its page, itself first."""
    pages: dict[str, list[str]] = {CORE: []}
    for file in sorted(PACKAGE.rglob("*.py")):
        parts = file.relative_to(PACKAGE).with_suffix("").parts
        if parts[-1] == "__main__" or parts == ("__init__",):
            continue
        if parts[-1] == "__init__":
            pages.setdefault(parts[0], []).append(".".join(("sim2gp", *parts[:-1])))
        else:
            page = parts[0] if len(parts) > 1 else CORE
            pages.setdefault(page, []).append(".".join(("sim2gp", *parts)))
    return pages


def public_names() -> dict[str, str]:
    """What ``sim2gp`` offers by name: where each thing is defined, as a dotted path."""
    found: dict[str, dict[str, str]] = {}
    for node in tree("sim2gp").body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Dict):
            found[ast.unparse(node.targets[0])] = ast.literal_eval(node.value)
    modules = {name: f"sim2gp.{home}" for name, home in found["_MODULES"].items()}
    return modules | {
        name: place(name, f"sim2gp.{home}") for name, home in found["_CONTENTS"].items()
    }


def place(name: str, module: str) -> str:
    """The dotted path of a thing that a module defines, or imports from elsewhere."""
    for node in tree(module).body:
        if isinstance(node, DEFINITIONS) and node.name == name:
            return f"{module}.{name}"
        if isinstance(node, ast.ImportFrom) and name in {a.name for a in node.names}:
            return place(name, node.module or "")
    raise LookupError(f"{module} neither defines nor imports {name}")


def reference() -> dict[str, str]:
    """The reference's pages by name: the names of ``sg``, then a page per package."""
    pages = modules()
    home = {module: page for page, found in pages.items() for module in found}
    lines = ["# Reference", "", "What `import sim2gp as sg` offers:", ""]
    lines += ["| name | what it is |", "|---|---|"]
    for name, path in public_names().items():
        module = path if path in home else path.rpartition(".")[0]
        says = first_sentence(path, module)
        lines.append(f"| [`sg.{name}`]({home[module]}.md#{path}) | {says} |")
    lines += ["", "## The tree", "", "Every module, by package:", ""]
    for page, found in pages.items():
        lines.append(f"- [{page}]({page}.md): " + heading(page, found))
    texts = {"index": "\n".join(lines) + "\n"}
    return texts | {page: _page(page, found) for page, found in pages.items()}


def heading(page: str, found: list[str]) -> str:
    """A page's content in a sentence."""
    if page == CORE:
        return "Types, errors and checks, compilation, and what every belief offers."
    return first_sentence(found[0], found[0])


def _page(page: str, found: list[str]) -> str:
    lines = [f"# {page}", "", heading(page, found), "", "| module | |", "|---|---|"]
    lines += [f"| [`{m}`](#{m}) | {first_sentence(m, m)} |" for m in found]
    for module in found:
        # What a package imports is described where it is defined.
        own = [
            node.name
            for node in tree(module).body
            if isinstance(node, DEFINITIONS) and node.name[0] != "_"
        ]
        lines += ["", f"::: {module}", "    options:", f"      members: {own or False}"]
    return "\n".join(lines) + "\n"


def first_sentence(path: str, module: str) -> str:
    """What the docstring of a module, or of a thing in it, begins with; one cell."""
    node: ast.Module | ast.ClassDef | ast.FunctionDef = tree(module)
    for inner in tree(module).body:
        if isinstance(inner, DEFINITIONS):
            node = inner if f"{module}.{inner.name}" == path else node
    text = ast.get_docstring(node) or ""
    return " ".join(text.split("\n\n")[0].split()).replace("|", "\\|")


def file_of(module: str) -> Path:
    """The file of a module of sim2gp; one that is not there where none is."""
    stem = PACKAGE.joinpath(*module.split(".")[1:])
    return stem / "__init__.py" if stem.is_dir() else stem.with_suffix(".py")


@cache
def tree(module: str) -> ast.Module:
    """A module's syntax: nothing of the package is imported to be described."""
    return ast.parse(file_of(module).read_text(encoding="utf-8"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
