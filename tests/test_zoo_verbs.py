"""Every verb of rl-zoo3, as typed on a command line, on a few hundred steps of small tasks."""

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import optuna
import pytest
import yaml

from sb3_gae import TRPOGAE
from sb3_gae.zoo import NET_ARCHS, default_hyperparams_path

ALGO_AND_ENV = ("--algo", "trpo_gae", "--env", "CartPole-v1")
SMALL = ("-params", "n_envs:2", "n_steps:128", "policy_kwargs:dict(net_arch=[16])")
N_TIMESTEPS, N_UPDATES = "1024", 4


def run(*command: str, cwd: Path, **environment: str) -> str:
    """
    Run a command that must succeed, with ``python`` being the one that runs the tests.

    :return: what it printed
    """
    variables = os.environ | {
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        "OMP_NUM_THREADS": "1",  # networks this small gain nothing from more
        "MPLBACKEND": "Agg",
        "SDL_VIDEODRIVER": "dummy",
    }
    result = subprocess.run(
        command, cwd=cwd, env=variables | environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=300
    )
    assert result.returncode == 0, f"{' '.join(command)}\n{result.stdout}"
    return result.stdout


def run_zoo(verb: str, *arguments: str, cwd: Path, **environment: str) -> str:
    return run("python", "-m", f"rl_zoo3.{verb}", *arguments, cwd=cwd, **environment)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one trained agent in ``logs``, which the tests read and add to."""
    folder = tmp_path_factory.mktemp("zoo")
    arguments = ("-n", N_TIMESTEPS, "--eval-freq", "256", "--eval-episodes", "2", "--save-freq", "512", "--seed", "1")
    output = run_zoo("train", *ALGO_AND_ENV, *arguments, "-tb", "tensorboard", "--progress", *SMALL, cwd=folder)
    (folder / "output.txt").write_text(output)
    return folder


@pytest.fixture(scope="module")
def trained(workplace: Path) -> Path:
    """The folder of the trained agent."""
    return workplace / "logs" / "trpo_gae" / "CartPole-v1_1"


def test_train_saves_all_that_the_zoo_saves(workplace: Path, trained: Path) -> None:
    assert f"Loading hyperparameters from: {default_hyperparams_path()}" in (workplace / "output.txt").read_text()
    files = {str(file.relative_to(trained)) for file in trained.rglob("*") if file.is_file()}
    assert files >= {
        *("CartPole-v1.zip", "best_model.zip", "rl_model_512_steps.zip", "rl_model_1024_steps.zip"),
        *("evaluations.npz", "0.monitor.csv", "1.monitor.csv", "CartPole-v1/args.yml", "CartPole-v1/config.yml"),
    }
    assert list((workplace / "tensorboard").rglob("events.out.tfevents.*"))
    arguments = yaml.unsafe_load((trained / "CartPole-v1" / "args.yml").read_text())
    assert arguments["track"] is False
    evaluations = np.load(trained / "evaluations.npz")
    assert list(evaluations["timesteps"]) == [256, 512, 768, 1024]
    assert np.all(evaluations["results"] >= 1)


@pytest.mark.parametrize("which", ["--load-best", "--load-last-checkpoint"])
def test_enjoy(workplace: Path, which: str) -> None:
    output = run_zoo("enjoy", *ALGO_AND_ENV, "-f", "logs", "-n", "600", "--no-render", which, cwd=workplace)
    assert re.search(r"Mean reward: \d+\.\d+ \+/- ", output)


def test_command_without_python_m(workplace: Path) -> None:
    output = run("rl_zoo3", "enjoy", *ALGO_AND_ENV, "-f", "logs", "-n", "600", "--no-render", cwd=workplace)
    assert re.search(r"Mean reward: \d+\.\d+ \+/- ", output)


def test_continue_from_a_trained_agent(trained: Path, tmp_path: Path) -> None:
    agent = ("-i", str(trained / "CartPole-v1.zip"))
    output = run_zoo("train", *ALGO_AND_ENV, *agent, "-n", "256", "--eval-freq", "-1", *SMALL, cwd=tmp_path)
    assert "Loading pretrained agent" in output
    n_updates = [
        TRPOGAE.load(folder / "CartPole-v1.zip", device="cpu")._n_updates
        for folder in (trained, tmp_path / "logs" / "trpo_gae" / "CartPole-v1_1")
    ]
    assert n_updates[1] == n_updates[0] + 1
    assert n_updates[0] >= N_UPDATES


def test_continue_and_enjoy_with_normalized_observations(tmp_path: Path) -> None:
    """Continuous actions too."""
    pendulum = ("--algo", "trpo_gae", "--env", "Pendulum-v1")
    train = ("-n", "512", "--eval-freq", "-1", *SMALL, "normalize:True")
    run_zoo("train", *pendulum, *train, cwd=tmp_path)
    first = Path("logs", "trpo_gae", "Pendulum-v1_1")
    assert (tmp_path / first / "Pendulum-v1" / "vecnormalize.pkl").is_file()

    output = run_zoo("train", *pendulum, "-i", str(first / "Pendulum-v1.zip"), *train, cwd=tmp_path)
    assert "Loading saved VecNormalize stats" in output

    output = run_zoo("enjoy", *pendulum, "-f", "logs", "-n", "400", "--no-render", cwd=tmp_path)
    assert "Loading latest experiment, id=2" in output
    assert "Loading running average" in output
    assert "2 Episodes" in output


def test_a_file_for_trpo_of_sb3_contrib_runs(tmp_path: Path) -> None:
    (tmp_path / "trpo.yml").write_text(
        textwrap.dedent("""
        CartPole-v1:
          n_envs: 2
          n_timesteps: !!float 1e5
          policy: 'MlpPolicy'
          n_steps: 128
          batch_size: 128
          cg_damping: !!float 1e-3
          cg_max_steps: 25
          gae_lambda: 0.98
          gamma: 0.99
          learning_rate: lin_1e-3
          n_critic_updates: 20
          sub_sampling_factor: 1
          normalize_advantage: True
          policy_kwargs: "dict(net_arch=[16], ortho_init=True)"
        """)
    )
    output = run_zoo("train", *ALGO_AND_ENV, "--conf-file", "trpo.yml", "-n", "512", "--eval-freq", "-1", cwd=tmp_path)
    assert "Loading hyperparameters from: trpo.yml" in output
    agent = TRPOGAE.load(tmp_path / "logs" / "trpo_gae" / "CartPole-v1_1" / "CartPole-v1.zip", device="cpu")
    assert (agent.gae_lambda, agent.cg_max_steps, agent.cg_damping) == (0.98, 25, 1e-3)


STUDY = ("--storage", "study.log", "--study-name", "study")
OPTIMIZE = ("-optimize", *STUDY, "--n-trials", "3", "--n-evaluations", "2", "--eval-episodes", "1", "--no-optim-plots")


def load_study(folder: Path) -> optuna.Study:
    backend = optuna.storages.journal.JournalFileBackend(str(folder / "study.log"))
    return optuna.load_study(study_name="study", storage=optuna.storages.JournalStorage(backend))


def test_optimize_and_train_with_a_trial(tmp_path: Path) -> None:
    search = ("-n", "512", "--sampler", "random", "--pruner", "none", "--seed", "0")
    run_zoo("train", *ALGO_AND_ENV, *OPTIMIZE, *search, cwd=tmp_path)
    trials = load_study(tmp_path).trials
    assert [trial.state.name for trial in trials] == ["COMPLETE"] * 3
    assert len({trial.params["one_minus_gamma"] for trial in trials}) == 3

    chosen = ("--trial-id", "1", "-n", "256", "--eval-freq", "-1")
    run_zoo("train", *ALGO_AND_ENV, *STUDY, *chosen, cwd=tmp_path)
    runs = (tmp_path / "logs" / "trpo_gae").glob("CartPole-v1_*/CartPole-v1.zip")
    agent = TRPOGAE.load(max(runs), device="cpu")
    params = trials[1].params
    assert agent.gamma == 1 - params["one_minus_gamma"]
    assert agent.vf_trust_region == params["vf_trust_region"]
    assert agent.target_kl == params["target_kl"]
    assert agent.policy.net_arch["vf"] == NET_ARCHS[params["net_arch"]]


def test_a_trial_whose_linear_algebra_fails_is_pruned_and_the_study_goes_on(tmp_path: Path) -> None:
    (tmp_path / "run.py").write_text(
        textwrap.dedent("""
        import runpy
        from sb3_gae import TRPOGAE
        from sb3_gae.errors import NumericalError

        train, models = TRPOGAE.train, set()

        def fail_in_the_second_trial(self):
            models.add(id(self.policy))
            if len(models) == 2 and not getattr(fail_in_the_second_trial, "failed", False):
                fail_in_the_second_trial.failed = True
                raise NumericalError("conjugate gradient met NaN")
            train(self)

        TRPOGAE.train = fail_in_the_second_trial
        runpy.run_module("rl_zoo3.train", run_name="__main__", alter_sys=True)
        """)
    )
    search = ("-n", "256", "--sampler", "random", "--pruner", "none", "--seed", "0")
    output = run("python", "run.py", *ALGO_AND_ENV, *OPTIMIZE, *search, cwd=tmp_path)
    assert "conjugate gradient met NaN" in output
    assert [trial.state.name for trial in load_study(tmp_path).trials] == ["COMPLETE", "PRUNED", "COMPLETE"]


def test_record_video(workplace: Path, tmp_path: Path) -> None:
    run_zoo("record_video", *ALGO_AND_ENV, "-f", "logs", "-o", str(tmp_path), "-n", "40", cwd=workplace)
    (video,) = tmp_path.glob("final-model-trpo_gae-CartPole-v1-*.mp4")
    assert video.stat().st_size > 1000


def test_record_training(trained: Path, tmp_path: Path) -> None:
    """The zoo calls ``ffmpeg``, of which moviepy brings a copy under another name."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    programs, run_folder = tmp_path / "bin", tmp_path / "logs" / "trpo_gae" / "CartPole-v1_1"
    programs.mkdir()
    run_folder.mkdir(parents=True)
    (programs / "ffmpeg").symlink_to(imageio_ffmpeg.get_ffmpeg_exe())
    for name in ("CartPole-v1.zip", "CartPole-v1"):
        (run_folder / name).symlink_to(trained / name)

    path = os.pathsep.join([str(programs), str(Path(sys.executable).parent), os.environ["PATH"]])
    run_zoo("record_training", *ALGO_AND_ENV, "-f", "logs", "-n", "40", cwd=tmp_path, PATH=path)
    assert (run_folder / "videos" / "training.mp4").stat().st_size > 1000


def test_plots(trained: Path, tmp_path: Path) -> None:
    """A comparison needs two runs at least, so here is one twice."""
    runs = tmp_path / "logs" / "trpo_gae"
    runs.mkdir(parents=True)
    for name in ("CartPole-v1_1", "CartPole-v1_2"):
        (runs / name).symlink_to(trained)

    output = run_zoo(
        "plots.all_plots", "-a", "trpo_gae", "-e", "CartPole", "-f", "logs", "-o", "results", "--no-million", cwd=tmp_path
    )
    assert re.search(r"CartPole *\| *\d+ \+/- \d+", output)  # a score, not the "0.0 +/- 0.0" of an empty folder

    plot = ("-l", "ours", "--boxplot", "-o", "figure.svg")
    run_zoo("plots.plot_from_file", "-i", "results.pkl", *plot, cwd=tmp_path)
    assert (tmp_path / "figure.svg").stat().st_size > 1000

    output = run_zoo("plots.plot_train", "-a", "trpo_gae", "-e", "CartPole", "-f", "logs", "-w", "5", cwd=tmp_path)
    assert "No data available" not in output


def test_benchmark(workplace: Path, tmp_path: Path) -> None:
    """It runs ``python enjoy.py``, which a checkout of the zoo has and docs/zoo.md gives in two lines."""
    (tmp_path / "enjoy.py").write_text("from rl_zoo3.enjoy import enjoy\nenjoy()\n")
    logs = str(workplace / "logs")
    run_zoo("benchmark", "--no-hub", "--log-dir", logs, "-n", "600", "--benchmark-dir", "results", cwd=tmp_path)
    table = (tmp_path / "results" / "benchmark.md").read_text()
    assert re.search(r"\|trpo_gae *\|CartPole-v1 *\|", table)


def test_push_to_and_load_from_the_hub(workplace: Path, tmp_path: Path) -> None:
    """The hub is a folder: nothing here uses the network."""
    (tmp_path / "offline.py").write_text(
        textwrap.dedent("""
        import os, runpy, shutil, sys
        from pathlib import Path
        import huggingface_hub
        from huggingface_hub import HfApi
        from huggingface_hub.errors import EntryNotFoundError

        hub = Path(os.environ["HUB"])

        def upload_folder(self, repo_id, folder_path, commit_message):
            shutil.copytree(folder_path, hub / repo_id)

        def hf_hub_download(repo_id, filename, **_):
            if (hub / repo_id / filename).is_file():
                return str(hub / repo_id / filename)
            raise EntryNotFoundError(filename)

        HfApi.create_repo = lambda self, repo_id, **_: repo_id
        HfApi.snapshot_download = lambda self, repo_id, local_dir: local_dir.mkdir(parents=True)
        HfApi.upload_folder = upload_folder
        huggingface_hub.hf_hub_download = hf_hub_download
        runpy.run_module(sys.argv.pop(1), run_name="__main__", alter_sys=True)
        """)
    )
    hub = tmp_path / "hub-server"
    offline, to_hub = ("python", str(tmp_path / "offline.py")), ("-orga", "someone")
    environment = {"HUB": str(hub), "TRUST_REMOTE_CODE": "True", "HF_HUB_OFFLINE": "1"}
    push = ("rl_zoo3.push_to_hub", *ALGO_AND_ENV, "-f", str(workplace / "logs"), "--no-render", *to_hub)
    run(*offline, *push, cwd=tmp_path, **environment)

    package = hub / "someone" / "trpo_gae-CartPole-v1"
    assert (package / "trpo_gae-CartPole-v1.zip").is_file()
    card = (package / "README.md").read_text()
    metadata = yaml.safe_load(card.split("---")[1])
    assert metadata["model-index"][0]["name"] == "TRPOGAE"
    assert "python -m rl_zoo3.enjoy --algo trpo_gae --env CartPole-v1" in card

    load = ("rl_zoo3.load_from_hub", *ALGO_AND_ENV, "-f", "loaded", *to_hub)
    assert "No normalization file" in run(*offline, *load, cwd=tmp_path, **environment)
    output = run_zoo("enjoy", *ALGO_AND_ENV, "-f", "loaded", "-n", "600", "--no-render", cwd=tmp_path)
    assert re.search(r"Mean reward: \d+\.\d+ \+/- ", output)
