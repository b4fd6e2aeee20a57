"""What the README shows works as it stands."""

import re
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"


def run_examples() -> list[dict]:
    scopes: list[dict] = []
    for example in re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL):
        scopes.append({})
        exec(example, scopes[-1])
        scopes[-1]["env"].close()
    return scopes


def test_the_examples_run_relabel_rows_and_fix_a_start() -> None:
    replay, gymnasium = run_examples()
    assert replay["batch"]["goal", "mask"].any()
    assert gymnasium["observation"]["pose"].tolist() == [0, 0, 0.5]


def test_every_file_that_is_linked_exists() -> None:
    links = re.findall(r"\]\(([^)#:]+)\)", README.read_text())
    assert links
    assert [link for link in links if not (README.parent / link).exists()] == []
