"""Rollouts in files: what is saved comes back, what is none is refused with the reason, and what the dial makes of it."""

import contextlib
import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_gae import TRPOGAE, SaveRolloutCallback
from sb3_gae.diagnostics.projected_scores import projected_scores
from sb3_gae.diagnostics.rollout_diagnostics import lambda_errors
from sb3_gae.diagnostics.rollout_file import Rollout, load_rollout, save_rollout
from sb3_gae.lab.rollout_view import SHIPPED_ROLLOUT, RolloutViewer
from sb3_gae.rollout.evaluation import training_batch


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[TRPOGAE, Path]:
    path = tmp_path_factory.mktemp("rollout") / "cartpole.npz"
    model = TRPOGAE("MlpPolicy", "CartPole-v1", n_steps=256, target_kl=1e-12, seed=0)
    model.learn(256, callback=SaveRolloutCallback(path))
    return model, path


def small_rollout(**changes: Any) -> Rollout:
    generator = np.random.default_rng(0)
    arrays = dict(zip(("rewards", "values", "next_values"), generator.normal(size=(3, 6, 2)), strict=True))
    dones = np.zeros((6, 2), dtype=bool)
    dones[[2, 5]] = True
    parts = dict(name="x", gamma=0.9, gae_lambda=0.9, dones=dones, mask=np.ones((6, 2), dtype=bool))
    return Rollout(**{**arrays, **parts, "scores": generator.normal(size=(12, 5)), **changes})


def content(**changes: Any) -> bytes:
    """A file of which some arrays are others, or, where None, missing."""
    rollout, file = small_rollout(), io.BytesIO()
    arrays = {"format": np.array("sb3-gae rollout 1"), **vars(rollout), **changes}
    np.savez(file, **{name: array for name, array in arrays.items() if array is not None})
    return file.getvalue()


def test_a_saved_rollout_comes_back(saved: tuple[TRPOGAE, Path]) -> None:
    model, path = saved
    buffer, rollout = model.rollout_buffer, load_rollout(path)
    assert rollout.name == "CartPole-v1" and rollout.gamma == model.gamma
    np.testing.assert_array_equal(rollout.rewards, buffer.rewards)
    np.testing.assert_array_equal(rollout.values, buffer.values.astype(np.float64))
    np.testing.assert_array_equal(rollout.dones, buffer.dones)
    assert len(rollout.scores) == buffer.n_samples


def test_projected_scores_keep_norms_on_average(saved: tuple[TRPOGAE, Path]) -> None:
    model, _ = saved
    batch = training_batch(model.rollout_buffer, model.action_space)
    projections = [projected_scores(model.policy, batch.take(np.arange(40)), 64, seed) for seed in range(3)]  # type: ignore[arg-type]
    norms = [np.square(each.sum(axis=0)).sum() for each in projections]
    assert np.ptp(norms) < 1.2 * np.mean(norms)
    full = lambda_errors(model.policy, model.rollout_buffer, [0.0, 0.9])
    view = RolloutViewer(load_rollout(saved[1])).view(model.gamma, 0.9)
    ratio = view.variance.value[0] / view.variance.value[4]
    expected = lambda_errors(model.policy, model.rollout_buffer, [0.0, 0.92]).variance
    assert ratio == pytest.approx(expected[0] / expected[1], rel=0.5)
    assert full.variance[0] < full.variance[1]


def test_the_shipped_rollout_shows_the_trade_off() -> None:
    assert SHIPPED_ROLLOUT.stat().st_size < 300_000
    viewer = RolloutViewer(load_rollout(SHIPPED_ROLLOUT))
    view = viewer.view(viewer.rollout.gamma, 0.97)
    assert np.all(np.diff(view.variance.value[:-1]) > 0.0)
    assert view.bias_squared.value[0] > view.bias_squared.value[5] > view.bias_squared.value[8] == pytest.approx(0.0)
    assert viewer.n_trajectories >= 16
    for response in viewer.response(viewer.rollout.gamma):
        assert len(response) > 20 and response.max() == pytest.approx(1.0)


def test_lambda_0_gives_the_residuals_and_1_the_unbiased() -> None:
    viewer = RolloutViewer(small_rollout())
    np.testing.assert_allclose(viewer.view(0.9, 0.0).advantages, viewer.view(0.9, 0.0).deltas)
    np.testing.assert_allclose(viewer.view(0.9, 1.0).advantages, viewer.view(0.9, 1.0).unbiased)
    steps, environments = viewer.steps(1)
    assert steps.tolist() == [3, 4, 5] and set(environments) == {0}


def test_a_file_that_was_not_changed_is_taken() -> None:
    assert load_rollout(content()).name == "x"


BAD_FILES = {
    "no archive": (b"PK\x03\x04 not really", "not a rollout"),
    "nothing": (b"", "not a rollout"),
    "pickle": (pickle.dumps({"rewards": 1}), "not a rollout"),
    "objects": (content(name=np.array([{}], dtype=object)), "kind 'O'"),
    "missing": (content(values=None), "no values"),
    "format": (content(format=np.array("2")), "format"),
    "shape": (content(values=np.zeros((5, 2))), "shape of `rewards`"),
    "axes": (content(rewards=np.zeros(6)), "axes"),
    "whole numbers": (content(rewards=np.zeros((6, 2), dtype=int)), "kind 'i'"),
    "not finite": (content(rewards=np.full((6, 2), np.nan)), "finite"),
    "factor": (content(gamma=np.array(1.5)), "gamma"),
    "rows": (content(scores=np.zeros((3, 5))), "12 steps"),
    "empty": (content(mask=np.zeros((6, 2), dtype=bool)), "at least 2"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files_are_refused_with_the_reason(name: str) -> None:
    bad, reason = BAD_FILES[name]
    with pytest.raises(ValueError, match=reason):
        load_rollout(bad)


def test_an_array_that_claims_to_be_huge_takes_no_memory() -> None:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, dict(descr="<f8", fortran_order=False, shape=(10**12, 2)))
    source, result = zipfile.ZipFile(io.BytesIO(content())), io.BytesIO()
    with zipfile.ZipFile(result, "w") as archive:
        for name in source.namelist():
            archive.writestr(name, file.getvalue() if name == "rewards.npy" else source.read(name))
    with pytest.raises(ValueError, match="shorter"):
        load_rollout(result.getvalue())


def test_a_bomb_is_refused() -> None:
    result = io.BytesIO()
    with zipfile.ZipFile(result, "w", zipfile.ZIP_DEFLATED) as archive:
        source = zipfile.ZipFile(io.BytesIO(content()))
        for name in source.namelist():
            archive.writestr(name, source.read(name))
        archive.writestr("more.npy", bytes(65 * 2**20))
    with pytest.raises(ValueError, match="unpacks"):
        load_rollout(result.getvalue())


@given(st.integers(0, 10**9), st.integers(1, 40))
def test_damage_is_refused_or_harmless(seed: int, n_bytes: int) -> None:
    generator, damaged = np.random.default_rng(seed), bytearray(content())
    damaged[int(generator.integers(len(damaged))) :][:n_bytes] = b""
    where = generator.integers(len(damaged), size=n_bytes)
    for place in where:
        damaged[place] = generator.integers(256)
    with contextlib.suppress(ValueError):
        assert isinstance(load_rollout(bytes(damaged)), Rollout)


def test_a_single_trajectory_is_refused() -> None:
    dones = np.zeros((6, 2), dtype=bool)
    mask = np.ones((6, 2), dtype=bool)
    mask[:, 1] = False
    with pytest.raises(ValueError, match="two trajectories"):
        RolloutViewer(small_rollout(dones=dones, mask=mask, scores=np.ones((6, 5))))


def test_saving_rounds_only_the_scores(tmp_path: Path) -> None:
    rollout = small_rollout()
    save_rollout(rollout, tmp_path / "x.npz")
    again = load_rollout(tmp_path / "x.npz")
    np.testing.assert_array_equal(again.rewards, rollout.rewards)
    scale = np.sqrt(np.square(rollout.scores).mean())
    np.testing.assert_allclose(again.scores, rollout.scores / scale, rtol=1e-3, atol=1e-3)


def test_a_file_that_cannot_be_replaced_stays_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that comes at any moment finds a whole rollout."""
    path = tmp_path / "x.npz"
    save_rollout(small_rollout(), path)
    before, seen = path.read_bytes(), []

    def half(file: Any, **arrays: np.ndarray) -> None:
        file.write(b"half")
        file.flush()
        seen.append(path.read_bytes())
        raise OSError("No space left on device")

    monkeypatch.setattr(np, "savez_compressed", half)
    with pytest.raises(OSError, match="No space left"):
        save_rollout(small_rollout(name="y"), path)
    assert seen == [before] and path.read_bytes() == before
    assert [found.name for found in tmp_path.iterdir()] == ["x.npz"]
    monkeypatch.undo()
    save_rollout(small_rollout(name="y"), path)
    assert load_rollout(path).name == "y" and [found.name for found in tmp_path.iterdir()] == ["x.npz"]
