"""What README and docs give to type in a shell: each command is known, and takes the options that it is given."""

import importlib.util
import re
import shlex
from pathlib import Path

import pytest

from sb3_gae.sweep.arguments import make_parser

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RESULTS = ROOT / "benchmarks" / "results" / "sweeps"
#: files of the user's own, which the text has before
OF_THE_USER = {"train.py", "enjoy.py", "-X"}


def commands_in(text: str) -> list[list[str]]:
    """:return: the words of each command in the text's shell blocks, continued lines joined, and in its sentences"""
    blocks = re.findall(r"^```bash\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    in_sentences = re.findall(r"(?<!`)`((?:python|make) [^`…]+)`(?!`)", text)
    lines += [
        line.replace("\n", " ")
        for line in in_sentences
        if "..." not in line and not line.endswith((" -m", "sb3_gae.sweep")) and not re.search(r"\b[A-Z]{2,}\b", line)
    ]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


COMMANDS = {
    f"{document.name}: {shlex.join(words)}": words for document in DOCUMENTS for words in commands_in(document.read_text())
}


def python_commands(of: str) -> list[str]:
    """:return: those that run a module (``"-m"``) or a file (``""``)"""
    found = []
    for name, words in COMMANDS.items():
        place = next((number for number, word in enumerate(words) if Path(word).name == "python"), None)
        if place is not None and len(words) > place + 1 and (words[place + 1] == "-m") == bool(of):
            found.append(name)
    return found


def after_python(name: str) -> list[str]:
    words = COMMANDS[name]
    return words[next(number for number, word in enumerate(words) if Path(word).name == "python") + 1 :]


def options(words: list[str]) -> set[str]:
    return {word.split("=")[0] for word in words if re.match(r"--?[a-z]", word)}


def sources(module: str) -> str:
    """:return: all code of the package or module that ``python -m`` runs"""
    top = importlib.util.find_spec(module.split(".")[0].replace("pytest", "_pytest"))
    assert top is not None, f"there is no {module}"
    assert importlib.util.find_spec(module) is not None, f"there is no {module}"
    return "\n".join(
        path.read_text() for folder in top.submodule_search_locations or () for path in Path(folder).rglob("*.py")
    )


def test_there_are_commands() -> None:
    assert len(python_commands("-m")) > 40
    assert len(python_commands("")) > 5


@pytest.mark.parametrize("name", [name for name in python_commands("-m") if "sb3_gae.sweep" in name])
def test_the_sweep_knows_its_arguments_and_files(name: str) -> None:
    args = make_parser().parse_args(after_python(name)[2:])
    given = [*(getattr(args, "sources", None) or ()), *(getattr(args, "files", None) or ())]
    files = [Path(file) for file in given if file.endswith(".parquet")]
    assert all((ROOT / file).exists() or (RESULTS / file).exists() for file in files)


@pytest.mark.parametrize("name", [name for name in python_commands("-m") if "sb3_gae.sweep" not in name])
def test_modules_are_there_and_have_the_options(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    _, module, *words = after_python(name)
    code = sources(module)
    missing = [option for option in options(words) if f'"{option}"' not in code]
    assert not missing


@pytest.mark.parametrize("name", python_commands(""))
def test_scripts_are_there_and_have_the_options(name: str) -> None:
    script, *words = after_python(name)
    if script in OF_THE_USER:
        return
    code = (ROOT / script).read_text()
    assert all(f'"{option}"' in code for option in options(words))


@pytest.mark.parametrize("name", [name for name, words in COMMANDS.items() if words[0] == "make"])
def test_make_has_the_targets(name: str) -> None:
    makefile = (ROOT / "Makefile").read_text().replace("$(TIANSHOU)", ".venv-tianshou")
    targets = [word for word in COMMANDS[name][1:] if "=" not in word]
    assert all(re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE) for target in targets)
