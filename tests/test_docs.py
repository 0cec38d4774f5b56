"""What the README and the pages of ``docs/`` show can be run, and is there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = {path.name: path.read_text() for path in PAGES}
# Budgets of the pages' blocks, and how CI cuts them
SMALL = {
    r"learn\(\d[\d_]*": "learn(1_000",
    r"n_eval_episodes=\d+": "n_eval_episodes=2",
    r"n_episodes=100": "n_episodes=10",
    r"n_estimates=\d+": "n_estimates=3",
}
MODULES = {"all_plots": "plots/all_plots", "plot_train": "plots/plot_train", "plot_from_file": "plots/plot_from_file"}


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def commands(text: str) -> list[str]:
    """The lines of the shell blocks, and the commands within sentences."""
    lines = [line for block in blocks(text, "sh") for line in block.splitlines()]
    spans = re.findall(r"`([^`]*)`", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL))
    return [part.strip() for line in lines + spans for part in line.replace("\n", " ").split("&&")]


COMMANDS = {(name, command) for name, text in TEXTS.items() for command in commands(text)}
WITH_OPTIONS = re.compile(r"(sb3_reinforce\.zoo|sb3-reinforce-zoo) \w|\.py\b.* --")


@pytest.mark.parametrize("name", [path.name for path in PAGES[1:] if blocks(path.read_text(), "python")])
@pytest.mark.filterwarnings("ignore")
def test_python_blocks_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, as one script, with small budgets. `.ci/wheel` runs the README's blocks as they stand."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    script = "\n".join(blocks(TEXTS[name], "python"))
    for budget, small in SMALL.items():
        script = re.sub(budget, small, script)
    exec(compile(script, name, "exec"), {"__name__": "__main__"})


def options_of(command: str) -> str:
    """The source that defines the options of a command that starts Python."""
    zoo = re.search(r"(?:-m sb3_reinforce\.zoo|sb3-reinforce-zoo) (\w+)", command)
    if zoo:
        rl_zoo3 = pytest.importorskip("rl_zoo3")
        return (Path(rl_zoo3.__file__).parent / f"{MODULES.get(zoo[1], zoo[1])}.py").read_text()
    script = re.search(r"python[\d.]* (\S+\.py)", command)
    return (ROOT / script[1]).read_text() if script else ""


@pytest.mark.parametrize(("name", "command"), sorted(entry for entry in COMMANDS if WITH_OPTIONS.search(entry[1])))
def test_commands_have_these_options(name: str, command: str) -> None:
    source = options_of(command)
    for option in re.findall(r"(?<= )--?[a-z][\w-]*", command.split("sb3_reinforce.zoo")[-1]):
        assert option == "--help" or f'"{option}"' in source, f"{name}: {command} has no option {option}"


@pytest.mark.parametrize("name", TEXTS)
def test_files_extras_and_make_targets_exist(name: str) -> None:
    text = TEXTS[name]
    paths = re.findall(r"[`\s(]((?:tests|examples|docs|sb3_reinforce|\.ci|\.github)/[\w./-]*\w)", text)
    paths += [path for path in re.findall(r"\]\(([^)#:]+)\)", text) if name == "README.md"]
    missing = [path for path in paths if not (ROOT / path).exists() and not path.startswith("docs/_build")]
    assert not missing
    project = (ROOT / "pyproject.toml").read_text()
    for extras in re.findall(r'pip install -e "\.\[([\w,]+)\]"', text):
        assert all(re.search(rf"^{extra} = \[", project, re.MULTILINE) for extra in extras.split(","))
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {target for span in re.findall(r"`make ([\w -]+)`", text) for target in span.split()} <= {*targets}


def test_named_tests_exist() -> None:
    for text in TEXTS.values():
        for path, test in re.findall(r"(tests/[\w/]+\.py)::(\w+)", text):
            assert f"def {test}(" in (ROOT / path).read_text(), f"{path}::{test}"


def test_the_readme_is_short_and_its_results_are_those_of_the_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pandas")
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    import tables

    assert tables.readme() in TEXTS["README.md"]
    assert len(TEXTS["README.md"].splitlines()) <= 130
