"""A report in a notebook: the same page, in a frame of its own."""

from html.parser import HTMLParser
from pathlib import Path

import sim2gp as sg
from sim2gp.commands.evaluation import Evaluation
from sim2gp.runs import new_run


class Frames(HTMLParser):
    """Collects what each element says of itself."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_a_notebook_gets_the_whole_report(tmp_path: Path) -> None:
    summary = {"command": "evaluate", "headline": "a < b & \"c\" 'd'"}
    with new_run(tmp_path / "run", "identify") as writer:
        writer.write_summary(summary)
        writer.write_arrays("arrays.npz", {})
    shown = sg.show(tmp_path / "run")
    frames = Frames()
    frames.feed(shown._repr_html_())
    ((tag, said),) = frames.found
    assert tag == "iframe"
    assert said["sandbox"] == "allow-scripts"
    assert said["srcdoc"] == sg.show(sg.load_run(tmp_path / "run")).page
    assert "</html>" in shown.page
    assert "a &lt; b" in shown.page
    assert len(repr(shown).splitlines()) == 1


def test_a_result_shows_its_warnings() -> None:
    said = ["W128 rows were also fitted to", "W128 rows were also fitted to", "W1 <b>"]
    made = Evaluation({"command": "evaluate", "headline": "Good.", "warnings": said})
    assert repr(made).splitlines() == ["Evaluation: Good.", said[0], said[2]]
    page = made._repr_html_()
    assert page.count(said[0]) == 1
    assert "W1 &lt;b&gt;" in page
