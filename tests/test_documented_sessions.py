"""What README and docs give to type in a shell, typed in the order of each page, on sizes of seconds."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from documented import COMMANDS, ROOT, after_python
from rliable import library

from sb3_gae.sweep.cli import main

#: added to a command, so that it ends soon; of an option that is given twice the last one counts
SMALLER = {
    "sb3_gae.sweep": "",
    "sb3_gae.sweep run": "--seeds 1 --iterations 2 --jobs 1 --no-progress -params n_envs:2 n_steps:64",
    "rl_zoo3.train": "-n 256 --eval-freq -1 -params n_envs:2 n_steps:64",
    "rl_zoo3.train -optimize": "-n 256 --n-trials 2 --n-evaluations 1 --no-optim-plots -params n_envs:2 n_steps:64",
    "rl_zoo3.train --trained-agent": "-n 4352 --eval-freq -1 -params n_envs:2 n_steps:64",
    "rl_zoo3.train --trial-id": "-n 256 --eval-freq -1 --trial-id 1 -params n_envs:2 n_steps:64",
    "rl_zoo3.enjoy": "-n 20 --no-render",
    # All that is committed has been run: it says so, and prints the table
    "benchmarks/first_results.py": "",
    "benchmarks/ray_scaling_model.py": "",
    "benchmarks.gate draw": "",
}

#: by the words that a command has, where else it is run, or why it is not
ELSEWHERE = {
    "make": "by CI, which does what each of its targets does; `make train` is run here",
    ".ci/release": "by CI",
    "benchmarks.gate": "by CI; tests/test_gate.py",
    "benchmarks.peers": "tests/test_peers_run.py, tests/test_peers_page.py",
    "benchmarks.speed": "tests/test_speed_benchmarks.py",
    "benchmarks/speed/bench.py": "tests/test_speed_benchmarks.py",
    "benchmarks/paper_tasks.py": "half a day; its runs are those of rl-zoo3",
    "benchmarks/update_speed.py": "minutes of a quiet machine; tests/test_speed_benchmarks.py",
    "benchmarks/rollout_speed.py": "minutes of a quiet machine",
    "benchmarks/ray_speed.py": "minutes of a quiet machine; tests/test_ray_scaling.py",
    "benchmarks/ray_hosts.py": "network namespaces; tests/test_ray_hosts.py",
    "benchmarks/fault_injection.py": "minutes; tests/test_fault_injection.py",
    "benchmarks/soak.py": "an hour",
    "benchmarks/dial_latency.py": "a quiet machine and a browser; tests/test_lab_page.py",
    "docs/house.py": "tests/test_house.py",
    "docs/contact_sheet.py": "agents that are trained for hours",
    "docs/record_biped.py": "tests/test_rollout_file.py",
    "docs/gridworld_figures.py": "tests/test_document_figures.py",
    "docs/measured_lambda.py": "tests/test_document_figures.py",
    "docs/lambda_variants.py": "tests/test_document_figures.py",
    "docs/training_figures.py": "tests/test_document_figures.py",
    "docs/value_errors.py": "tests/test_document_figures.py",
    "docs/rules_over_tasks.py": "tests/test_sweep_ranking.py",
    "sb3_gae.gridworld": "serves until it is stopped; tests/test_lab_cli.py",
    "rl_zoo3.record_video": "tests/test_zoo_verbs.py",
    "rl_zoo3.record_training": "tests/test_zoo_verbs.py",
    "rl_zoo3.plots.plot_train": "tests/test_zoo_verbs.py",
    "rl_zoo3.plots.all_plots": "tests/test_zoo_verbs.py",
    "rl_zoo3.plots.plot_from_file": "tests/test_zoo_verbs.py",
    "rl_zoo3.benchmark": "tests/test_zoo_verbs.py",
    "enjoy.py": "tests/test_zoo_verbs.py",
    "importtime": "tests/test_zoo_hook.py",
    "rollout_workers:2": "tests/test_ray_workers.py",
    "postgresql+psycopg": "tests/test_sweep_postgresql.py",
    "pip": "by CI",
    "source": "nothing to see",
    "sudo": "changes the machine",
    "ray": "a cluster",
    "train.py": "a cluster",
}
#: blocks that are for a cluster altogether
OF_CLUSTERS = ("srun", "scontrol", "helm", "kubectl", "SLURM", "ray get-auth-token", "RAY_ADDRESS", "RAY_AUTH_MODE", "sleep")

#: what a reader has by then
A_TASK = """
import gymnasium

gymnasium.register("{id}", entry_point="gymnasium.envs.classic_control:PendulumEnv", max_episode_steps=50)
"""


def elsewhere(words: list[str]) -> bool:
    line = shlex.join(words)
    return any(word in line for word in OF_CLUSTERS) or any(
        word in ELSEWHERE or word.partition("://")[0] in ELSEWHERE for word in [*words, Path(words[0]).name]
    )


def recipe(target: str) -> list[str]:
    """:return: what the Makefile runs for a target of one line"""
    text = (ROOT / "Makefile").read_text()
    (line,) = re.findall(rf"^{target}:.*\n\t\$\(IN_VENV\) (.*) \$\(ARGS\)$", text, re.MULTILINE)
    return shlex.split(line)


def to_run(document: str) -> list[list[str]]:
    """:return: the page's commands that are run here, each once in a folder"""
    found: list[list[str]] = []
    for words in COMMANDS[document]:
        command = recipe("train") if words == ["make", "train"] else words
        if command[0] == "cd" or (not elsewhere(command) and command not in found):
            found.append(command)
    return found


def smaller(words: list[str]) -> list[str]:
    """:return: what the interpreter is given, and :data:`SMALLER` of it, their hyperparameters in one place"""
    rest = [word for word in after_python(words) if word != "-m"]
    keys = [key for key in SMALLER if rest[0] == key.split()[0] and set(key.split()[1:]) <= set(rest)]
    assert keys, f"Say in SMALLER how to run it on a small size, or in ELSEWHERE what does: {shlex.join(words)}"
    given, more = list(rest), SMALLER[max(keys, key=len)].split()
    if "-params" in given and "-params" in more:
        start = given.index("-params")
        stop = next((n for n in range(start + 1, len(given)) if given[n].startswith("-")), len(given))
        more += given[start + 1 : stop]
        del given[start:stop]
    return given + more


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """What a reader finds in the folder of the checkout, and the files that pages speak of."""
    ignored = shutil.ignore_patterns("_build", "__pycache__")
    for name in ("benchmarks", "docs"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=ignored)
    (tmp_path / "my_module.py").write_text(A_TASK.format(id="MyEnv-v0"))
    (tmp_path / "my_tasks.py").write_text(A_TASK.format(id="SwingUp-v0"))
    return tmp_path


def at_work(document: str) -> bool:
    return any(words[0] != "cd" for words in to_run(document))


@pytest.mark.parametrize("document", [name for name in COMMANDS if at_work(name)])
def test_a_page_can_be_typed(document: str, checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(checkout))
    monkeypatch.setenv("PYTHONPATH", str(checkout))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.chdir(checkout)
    estimates = library.get_interval_estimates
    # The numbers are of no interest here, and a page has dozens of tables
    monkeypatch.setattr(library, "get_interval_estimates", lambda *args, **kwargs: estimates(*args, **(kwargs | {"reps": 20})))
    prepare(document)
    for words in to_run(document):
        if words[0] == "cd":
            os.chdir(checkout / words[1])
        else:
            run(smaller(words))


def prepare(document: str) -> None:
    """Leave in the current folder what a page takes to be there."""
    if document == "sweeps.md":
        of_another = "run --env MyEnv-v0 --gym-packages my_module --gammas .96 --lambdas .92 --first-seed 7"
        run(smaller(["python", "-m", "sb3_gae.sweep", *of_another.split()]))
        run(["sb3_gae.sweep", "export", "--name", "MyEnv-v0", "-o", "from_there.csv"])
        shutil.rmtree("logs")
    elif document == "checkpoints.md":
        (callback,) = re.findall(r'"(callback:\[.*\])"', (ROOT / "docs" / document).read_text())
        train = ["rl_zoo3.train", "--algo", "trpo_gae", "--env", "CartPole-v1", "-n", "4096", "--eval-freq", "-1"]
        run([*train, "-params", "n_envs:2", "n_steps:64", callback])


def run(words: list[str]) -> None:
    """A command that must succeed. Those of sweeps, of which there are many, run in this process."""
    program, *rest = words
    if program == "sb3_gae.sweep":
        assert main(rest) == 0, shlex.join(words)
        return
    module = [] if program.endswith(".py") else ["-m"]
    command = [sys.executable, *module, program, *rest]
    ended = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert ended.returncode == 0, f"{shlex.join(words)}\n{ended.stdout}"
