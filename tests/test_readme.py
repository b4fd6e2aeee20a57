"""What the README shows works as it stands."""

import re
from pathlib import Path

import pytest

import halgan_envs

ROOT = Path(__file__).parents[1]
README, CONTRIBUTING = ROOT / "README.md", ROOT / "CONTRIBUTING.md"


def run_examples(document: Path) -> list[dict]:
    scopes: list[dict] = []
    for example in re.findall(r"```python\n(.*?)```", document.read_text(), re.DOTALL):
        scopes.append({})
        exec(example, scopes[-1])
    return scopes


def test_the_examples_run_relabel_rows_fill_in_a_domain_and_fix_a_start() -> None:
    replay, foreign, gymnasium = run_examples(README)
    assert replay["batch"]["goal", "mask"].any()
    assert foreign["domain"].name == "my-room"
    assert foreign["env"].reset()["pixels"].shape == foreign["domain"].image_shape
    assert gymnasium["observation"]["pose"].tolist() == [0, 0, 0.5]


def test_the_task_that_contributing_adds_can_be_solved_and_gives_near_goal_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(halgan_envs.NAMES, "look-at-2m", None)  # so that it is gone afterwards
    (added,) = run_examples(CONTRIBUTING)
    assert added["near_goal"]["pixels"].shape == (100, 64, 64, 3)
    box = added["near_goal"]["pixels"][-1].astype(int)
    assert (box[..., 2] - box[..., 0] > 80).sum() > 20  # something blue is ahead


DOCUMENTS = [README, CONTRIBUTING, ROOT / "benchmarks" / "README.md", *sorted((ROOT / "results").glob("*.md"))]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_file_and_heading_that_is_linked_exists(document: Path) -> None:
    links = re.findall(r"\]\(([^):]+)\)", document.read_text())
    assert links or document == CONTRIBUTING
    assert [link for link in links if not is_there(document.parent, *link.partition("#")[::2])] == []


def is_there(folder: Path, path: str, heading: str) -> bool:
    if not heading:
        return (folder / path).exists()
    headings = re.findall(r"^#+ (.*)$", (folder / path).read_text(), re.MULTILINE)
    return heading in {re.sub(r"[^\w\- ]", "", each).lower().replace(" ", "-") for each in headings}
