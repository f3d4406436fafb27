"""The paper's tasks: what the paper says of them, and what an environment must keep to. Every check runs on every task."""

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from headless import run_headless
from stable_baselines3.common.env_checker import check_env as check_sb3_env

from sb3_gae.envs import TASKS, MujocoTask, MujocoTaskEnv, register_tasks


@dataclass(frozen=True)
class Facts:
    """
    What is known of a task from elsewhere.

    :param gears: largest torque of each motor in N·m; none where actions are discrete
    :param limbs: bodies whose contacts with the floor cost, each with all that hangs on it
    """

    n_observations: int
    dt: float
    max_episode_steps: int
    gears: tuple[float, ...] = ()
    torque_cost_weight: float = 0.0
    impact_cost_weight: float = 0.0
    limbs: tuple[str, ...] = ()
    alive_bonus: float | None = None
    lowest_height: float | None = None


BIPED_GEARS = (100.0,) * 6 + (20.0,) * 4
QUADRUPED_LEGS = ("front_left_leg", "back_left_leg", "back_right_leg", "front_right_leg")
FACTS = {
    "GaeCartPole-v0": Facts(4, 0.02, 1000, alive_bonus=1.0),
    "GaeBiped-v0": Facts(33, 0.01, 2000, BIPED_GEARS, 1e-5, 1e-5, ("right_thigh", "left_thigh"), 0.2, 0.8),
    "GaeQuadruped-v0": Facts(29, 0.01, 2000, (60.0,) * 8, 1e-6, 1e-3, QUADRUPED_LEGS, 0.05, 0.2),
    "GaeBipedStandup-v0": Facts(33, 0.01, 2000, BIPED_GEARS, 1e-5),
}
CONTINUOUS = [task_id for task_id, facts in FACTS.items() if facts.gears]
LOCOMOTION = [task_id for task_id, facts in FACTS.items() if facts.lowest_height]

every_task = pytest.mark.parametrize("task_id", TASKS)


def make(task_id: str, **kwargs: Any) -> MujocoTaskEnv:
    """The environment without its wrappers."""
    env = gym.make(task_id, **kwargs).unwrapped
    assert isinstance(env, MujocoTaskEnv)
    return env


def random_action(env: gym.Env, rng: np.random.Generator) -> Any:
    """Of the whole space, and a little beyond."""
    if isinstance(env.action_space, spaces.Discrete):
        return rng.integers(env.action_space.n)
    return rng.uniform(-1.2, 1.2, env.action_space.shape).astype(np.float32)


def rollout(env: gym.Env, seed: int, n_steps: int = 60) -> np.ndarray:
    """Observations, rewards and endings of random actions, with a reset every 20 steps."""
    rng = np.random.default_rng(seed)
    rows = []
    for step in range(n_steps):
        if step % 20 == 0:
            observation, _ = env.reset(seed=seed if step == 0 else None)
            rows.append([*observation, 0.0, 0.0])
        observation, reward, terminated, _, _ = env.step(random_action(env, rng))
        rows.append([*observation, reward, terminated])
    return np.array(rows)


def test_every_task_is_checked() -> None:
    assert FACTS.keys() == TASKS.keys()
    register_tasks()  # again


# What the paper says


@every_task
def test_sizes_and_times(task_id: str) -> None:
    facts, env = FACTS[task_id], gym.make(task_id)
    assert env.spec is not None
    assert env.spec.max_episode_steps == facts.max_episode_steps
    base = make(task_id)
    assert base.dt == pytest.approx(facts.dt, rel=1e-12)
    assert base.metadata["render_fps"] == round(1 / facts.dt)
    assert env.observation_space == spaces.Box(-np.inf, np.inf, (facts.n_observations,), np.float64)
    expected = spaces.Box(-1.0, 1.0, (len(facts.gears),), np.float32) if facts.gears else spaces.Discrete(2)
    assert env.action_space == expected


@every_task
def test_an_episode_is_cut_after_the_paper_s_number_of_steps(task_id: str) -> None:
    """With nothing that ends it before."""
    never = {"lowest_height": -math.inf} if task_id in LOCOMOTION else {}
    never = {"largest_angle": math.inf, "largest_position": math.inf} if task_id == "GaeCartPole-v0" else never
    env = gym.make(task_id, **never)
    env.reset(seed=0)
    action = 0 if isinstance(env.action_space, spaces.Discrete) else np.zeros(env.action_space.shape, np.float32)
    for step in range(1, FACTS[task_id].max_episode_steps + 1):
        _, _, terminated, truncated, _ = env.step(action)
        assert not terminated
        assert truncated == (step == FACTS[task_id].max_episode_steps)


def floor_forces(env: MujocoTaskEnv, limb: str) -> np.ndarray:
    """The floor's force on a limb in newtons, summed over the contacts by hand."""
    model, data = env.model, env.data
    limb_id, floor, total, force = model.body(limb).id, model.geom("floor").id, np.zeros(3), np.zeros(6)
    for i in range(data.ncon):
        geoms = list(data.contact[i].geom)
        assert floor in geoms, "only the floor is touched"
        body = model.geom_bodyid[geoms[1 - geoms.index(floor)]]
        while body not in (0, limb_id):
            body = model.body_parentid[body]
        if body == limb_id:
            mujoco.mj_contactForce(model, data, i, force)
            total += data.contact[i].frame.reshape(3, 3).T @ force[:3]
    return total


def heads_height(env: MujocoTaskEnv) -> float:
    """In the present state: after a step, MuJoCo's own numbers are of the state before."""
    site = mujoco.mj_name2id(env.model, mujoco.mjtObj.mjOBJ_SITE, "head")
    if site < 0:
        return math.nan
    data = mujoco.MjData(env.model)
    data.qpos[:] = env.data.qpos
    mujoco.mj_kinematics(env.model, data)
    return float(data.site_xpos[site, 2])


def expected_terms(env: MujocoTaskEnv, facts: Facts, before: np.ndarray, action: Any, head: float) -> dict[str, float]:
    """
    What the paper's formulas give.

    :param before: observation before the step, which is the state that the sensors see
    :param head: its height before the step
    """
    if not facts.gears:
        return {"alive_bonus": 1.0}
    terms = {}
    if facts.lowest_height is not None:
        terms["forward_velocity"] = float(before[env.model.nq])
    if facts.alive_bonus is None:
        terms["head_height_cost"] = -((head - 1.5) ** 2)
    torques = np.clip(action.astype(np.float64), -1.0, 1.0) * facts.gears
    terms["torque_cost"] = -facts.torque_cost_weight * float(torques @ torques)
    if facts.limbs:
        forces = np.concatenate([floor_forces(env, limb) for limb in facts.limbs])
        terms["impact_cost"] = -facts.impact_cost_weight * float(np.square(np.clip(forces, -1.0, 1.0)).sum())
        assert facts.alive_bonus is not None
        terms["alive_bonus"] = facts.alive_bonus
    return terms


@every_task
def test_rewards_are_the_paper_s(task_id: str) -> None:
    facts, env, rng = FACTS[task_id], make(task_id), np.random.default_rng(0)
    seen: dict[str, list[float]] = {}
    for step in range(150):
        if step % 50 == 0:
            before, _ = env.reset(seed=step)
        head = heads_height(env)
        action = random_action(env, rng)
        after, reward, _, _, info = env.step(action)
        assert reward == pytest.approx(sum(info.values()), rel=0, abs=1e-12)
        assert info == pytest.approx(expected_terms(env, facts, before, action, head), rel=1e-9, abs=1e-12)
        for name, value in info.items():
            seen.setdefault(name, []).append(value)
        before = after
    for name, values in seen.items():
        assert any(values), f"{name} was always 0"
        assert name == "alive_bonus" or len(set(values)) > 2, f"{name} hardly changed"


@pytest.mark.parametrize("task_id", LOCOMOTION)
def test_each_component_of_an_impact_counts_up_to_1_newton(task_id: str) -> None:
    env, facts = make(task_id), FACTS[task_id]
    env.reset(seed=0)
    forces, costs = [], []
    for _ in range(100):
        _, _, _, _, info = env.step(np.zeros(len(facts.gears), np.float32))
        forces.append(np.concatenate([floor_forces(env, limb) for limb in facts.limbs]))
        costs.append(-info["impact_cost"])
    assert np.abs(forces).max() > 10.0, "the feet came down"
    assert max(costs) <= facts.impact_cost_weight * 3 * len(facts.limbs) * (1 + 1e-12)


@pytest.mark.parametrize("task_id", LOCOMOTION)
def test_an_episode_ends_below_the_paper_s_height(task_id: str) -> None:
    env, limit = make(task_id), FACTS[task_id].lowest_height
    env.reset(seed=0)
    outcomes = []
    for height in limit + np.array([-0.1, -0.05, -0.02, 0.02, 0.05, 0.1]):
        qpos = env.data.qpos.copy()
        # On the side, so that no leg reaches the floor
        qpos[2:7] = height, math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0
        env.set_state(qpos, np.zeros(env.model.nv))
        observation, _, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape, np.float32))
        assert terminated == (observation[2] < limit)
        assert not truncated
        outcomes.append(terminated)
    assert {True, False} == set(outcomes)
    assert ends(env, "qpos", 2, limit - 1e-9)
    assert not ends(env, "qpos", 2, limit + 1e-9)


def ends(env: MujocoTaskEnv, what: str, index: int, value: float) -> bool:
    """Whether a state of zeros but for one number is the end."""
    physics = np.zeros((1, env.physics_state.size))
    physics[0, 1 + index + (env.model.nq if what == "qvel" else 0)] = value
    states = env.task.states(physics, np.zeros((1, env.model.nu)), np.zeros((1, env.model.nsensordata)))
    return bool(env.task.terminated(states)[0])


def test_getting_up_never_ends() -> None:
    env = make("GaeBipedStandup-v0")
    assert not any(ends(env, "qpos", 2, height) for height in (-10.0, 0.0, 0.1, 1.4, 10.0))


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("index", "limit"), [(0, 2.4), (1, math.radians(12.0))], ids=["position", "angle"])
def test_balancing_ends_outside_the_paper_s_range(index: int, limit: float, sign: float) -> None:
    env = make("GaeCartPole-v0")
    assert ends(env, "qpos", index, sign * (limit + 1e-9))
    assert not ends(env, "qpos", index, sign * (limit - 1e-9))
    for inside in (True, False):
        qpos = np.zeros(2)
        qpos[index] = sign * (limit - 0.02 if inside else limit + 0.02)
        env.set_state(qpos, np.zeros(2))
        _, reward, terminated, truncated, _ = env.step(1)
        assert (reward, terminated, truncated) == (1.0, not inside, False)


def cart_pole_step(state: np.ndarray, force: float) -> np.ndarray:
    """Barto, Sutton and Anderson's equations as put right by Florian, without friction, and semi-implicit Euler."""
    gravity, cart, pole, half_length, dt = 9.8, 1.0, 0.1, 0.5, 0.02
    x, angle, speed, angular_speed = state
    sine, cosine, total = math.sin(angle), math.cos(angle), cart + pole
    push = (-force - pole * half_length * angular_speed**2 * sine) / total
    angular = (gravity * sine + cosine * push) / (half_length * (4 / 3 - pole * cosine**2 / total))
    linear = (force + pole * half_length * (angular_speed**2 * sine - angular * cosine)) / total
    speed, angular_speed = speed + dt * linear, angular_speed + dt * angular
    return np.array([x + dt * speed, angle + dt * angular_speed, speed, angular_speed])


def test_the_cart_pole_moves_by_the_closed_form() -> None:
    env, rng = make("GaeCartPole-v0"), np.random.default_rng(0)
    for _ in range(20):
        state = rng.uniform((-2.0, -0.5, -2.0, -2.0), (2.0, 0.5, 2.0, 2.0))
        env.set_state(state[:2], state[2:])
        for _ in range(10):
            action = rng.integers(2)
            state = cart_pole_step(state, 10.0 if action == 1 else -10.0)
            np.testing.assert_allclose(env.step(action)[0], state, rtol=0, atol=1e-9)


def lowest_points(env: MujocoTaskEnv) -> dict[str, float]:
    """Height of the lowest point of every sphere and capsule, by name."""
    lowest = {}
    for i in range(env.model.ngeom):
        kind, size = mujoco.mjtGeom(env.model.geom_type[i]), env.model.geom_size[i]
        if kind == mujoco.mjtGeom.mjGEOM_PLANE:
            continue
        assert kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
        half_length = size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
        upright = abs(env.data.geom_xmat[i].reshape(3, 3)[2, 2])
        lowest[env.model.geom(i).name] = float(env.data.geom_xpos[i, 2] - half_length * upright - size[0])
    return lowest


@pytest.mark.parametrize("task_id", LOCOMOTION)
def test_the_start_is_a_stand_on_the_floor(task_id: str) -> None:
    env = make(task_id, reset_noise=0.0)
    env.reset(seed=0)
    lowest = lowest_points(env)
    feet = [name for name in lowest if name.endswith("_foot")]
    assert len(feet) == len(FACTS[task_id].limbs)
    assert min(lowest.values()) > -0.003
    assert all(lowest[foot] < 0.02 for foot in feet)
    assert all(height > 0.05 for name, height in lowest.items() if name not in feet)
    assert env.data.ncon <= len(feet)


def test_the_biped_is_as_tall_as_in_the_paper() -> None:
    env = make("GaeBiped-v0", reset_noise=0.0)
    env.reset(seed=0)
    assert env.data.body("torso").xpos[2] == pytest.approx(1.4)
    assert 1.4 < env.data.site("head").xpos[2] < 1.65


def test_getting_up_begins_on_the_back_with_no_limb_in_the_floor() -> None:
    env = make("GaeBipedStandup-v0")
    for seed in range(30):
        env.reset(seed=seed)
        assert min(lowest_points(env).values()) > -0.003
        assert env.data.site("head").xpos[2] < 0.3
        # The torso's x axis, which points forward when it stands, points up
        assert env.data.body("torso").xmat.reshape(3, 3)[2, 0] > 0.99
    np.testing.assert_allclose(np.linalg.norm(env.data.qpos[3:7]), 1.0, atol=1e-12)


# What an environment must keep to


@every_task
def test_checkers_find_nothing(task_id: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Positions and velocities have no bounds
        warnings.filterwarnings("ignore", message=".*Box observation space (minimum|maximum) value is -?infinity")
        check_gymnasium_env(make(task_id), skip_render_check=True)
        check_sb3_env(make(task_id), warn=True, skip_render_check=True)


@every_task
@pytest.mark.parametrize("how", ["random", "lowest", "highest", "alternating"])
def test_observations_and_rewards_are_finite_whatever_is_done(task_id: str, how: str) -> None:
    env, rng = gym.make(task_id), np.random.default_rng(0)
    discrete = isinstance(env.action_space, spaces.Discrete)
    low, high = (0, 1) if discrete else (env.action_space.low, env.action_space.high)
    over = True
    for step in range(300):
        if over or step % 100 == 99:
            observation, _ = env.reset(seed=step)
            assert np.isfinite(observation).all()
        actions = {"random": random_action(env, rng), "lowest": low, "highest": high, "alternating": (low, high)[step % 2]}
        observation, reward, terminated, truncated, info = env.step(actions[how])
        assert env.observation_space.contains(observation)
        assert np.isfinite(observation).all()
        assert math.isfinite(reward)
        assert "numerical_failure" not in info
        over = terminated or truncated


@pytest.mark.parametrize("task_id", CONTINUOUS)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_actions_beyond_the_bounds_are_cut_to_them(task_id: str, sign: float) -> None:
    results = []
    for size in (1.0, 1e6):
        env = make(task_id)
        env.reset(seed=0)
        results.append([env.step(np.full(env.action_space.shape, sign * size, np.float32))[:2] for _ in range(20)])
    for (bounded, bounded_reward), (huge, huge_reward) in zip(*results, strict=True):
        np.testing.assert_array_equal(bounded, huge)
        assert bounded_reward == huge_reward


@every_task
def test_actions_do_something(task_id: str) -> None:
    ends_at = []
    for action in (0, 1):
        env = make(task_id)
        env.reset(seed=0)
        discrete = isinstance(env.action_space, spaces.Discrete)
        for _ in range(5):
            observation, *_ = env.step(action if discrete else np.full(env.action_space.shape, action, np.float32))
        ends_at.append(observation)
    # The last velocities are those of the joints that have motors, or of cart and pole
    n_joints = len(FACTS[task_id].gears) or 2
    assert (np.abs(ends_at[0] - ends_at[1])[-n_joints:] > 1e-3).all()


@every_task
def test_a_seed_decides_the_trajectory(task_id: str) -> None:
    first = rollout(gym.make(task_id), seed=3)
    np.testing.assert_array_equal(first, rollout(gym.make(task_id), seed=3))
    env = gym.make(task_id)
    rollout(env, seed=8)
    np.testing.assert_array_equal(first, rollout(env, seed=3), "whatever was before it")


@every_task
def test_seeds_and_resets_differ(task_id: str) -> None:
    env = make(task_id)
    starts = [env.reset(seed=seed)[0] for seed in (0, 1, 2)] + [env.reset()[0] for _ in range(3)]
    assert len({start.tobytes() for start in starts}) == len(starts)


@every_task
def test_no_observation_is_constant(task_id: str) -> None:
    """Within one episode, so that random starts hide nothing."""
    env, rng = make(task_id), np.random.default_rng(0)
    rows = [env.reset(seed=0)[0], *[env.step(random_action(env, rng))[0] for _ in range(15)]]
    assert (np.ptp(rows, axis=0) > 1e-3).all()


@every_task
def test_what_was_returned_is_not_changed_by_the_next_step(task_id: str) -> None:
    env, rng = make(task_id), np.random.default_rng(0)
    first, _ = env.reset(seed=0)
    second, _, _, _, info = env.step(random_action(env, rng))
    kept = first.copy(), second.copy(), dict(info)
    env.step(random_action(env, rng))
    np.testing.assert_array_equal(first, kept[0])
    np.testing.assert_array_equal(second, kept[1])
    assert info == kept[2]


@every_task
def test_numbers_that_blow_up_cut_the_episode(task_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file
    env, rng = make(task_id), np.random.default_rng(0)
    env.reset(seed=0)
    terms = set(env.step(random_action(env, rng))[4])
    huge = np.full(env.model.nv, 1e11)
    env.set_state(env.data.qpos.copy(), huge)
    observation, reward, terminated, truncated, info = env.step(random_action(env, rng))
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert info == dict.fromkeys(terms, 0.0) | {"numerical_failure": True}
    assert np.isfinite(observation).all()
    np.testing.assert_array_equal(observation[env.model.nq :], huge, "the state before is the last one")

    env.reset(seed=0)
    fresh = make(task_id)
    fresh.reset(seed=0)
    action = random_action(env, rng)
    for found, expected in zip(env.step(action), fresh.step(action), strict=True):
        np.testing.assert_array_equal(found, expected, "nothing is left of it")


@pytest.mark.parametrize("task_id", CONTINUOUS)
def test_an_action_that_is_not_a_number_does_not_reach_the_state(
    task_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    env = make(task_id)
    env.reset(seed=0)
    observation, *_ = env.step(np.full(env.action_space.shape, np.nan, np.float32))
    assert np.isfinite(observation).all()


# Settings


SETTINGS: dict[str, dict[str, float]] = {
    "GaeCartPole-v0": {"force": 3.0, "largest_angle": 0.02, "largest_position": 0.01, "reset_noise": 0.0},
    "GaeBiped-v0": {
        "torque_cost_weight": 0.5,
        "impact_cost_weight": 0.5,
        "largest_impact_force": 3.0,
        "alive_bonus": 7.0,
        "lowest_height": 9.0,
        "reset_noise": 0.0,
    },
    "GaeBipedStandup-v0": {"torque_cost_weight": 0.5, "target_head_height": 3.0, "reset_noise": 0.0},
}
SETTINGS["GaeQuadruped-v0"] = SETTINGS["GaeBiped-v0"]


@pytest.mark.parametrize(("task_id", "name"), [(task_id, name) for task_id in SETTINGS for name in SETTINGS[task_id]])
def test_each_setting_changes_the_task(task_id: str, name: str) -> None:
    value = SETTINGS[task_id][name]
    env = make(task_id, **{name: value})
    assert getattr(env.task, name) == value
    different = rollout_with_infos(make(task_id)) != rollout_with_infos(env)
    assert different, "and not only an attribute"


def rollout_with_infos(env: MujocoTaskEnv) -> list[Any]:
    rng = np.random.default_rng(0)
    rows: list[Any] = [env.reset(seed=0)[0].tolist()]
    for _ in range(60):
        observation, *rest = env.step(random_action(env, rng))
        rows.append([observation.tolist(), *rest])
    return rows


def test_settings_scale_what_they_name() -> None:
    def info_of(**kwargs: float) -> dict[str, float]:
        env = make("GaeBiped-v0", reset_noise=0.0, **kwargs)
        env.reset(seed=0)
        for _ in range(5):
            _, _, _, _, info = env.step(np.full(10, 0.01, np.float32))
        return info

    usual = info_of()
    assert usual["impact_cost"] < 0.0, "it stands on its feet"
    assert info_of(torque_cost_weight=3e-5)["torque_cost"] == pytest.approx(3 * usual["torque_cost"])
    assert info_of(impact_cost_weight=3e-5)["impact_cost"] == pytest.approx(3 * usual["impact_cost"])
    assert info_of(alive_bonus=7.0)["alive_bonus"] == 7.0


@every_task
def test_a_setting_that_there_is_not_is_refused(task_id: str) -> None:
    with pytest.raises(TypeError, match="no_such_setting"):
        make(task_id, no_such_setting=1.0)


# Bad input


@every_task
def test_a_step_before_the_first_reset_is_refused(task_id: str) -> None:
    env = make(task_id)
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        env.step(env.action_space.sample())


@every_task
def test_an_unknown_render_mode_is_refused(task_id: str) -> None:
    with pytest.raises(ValueError, match=r"`render_mode` must be one of .*rgb_array.*, got 'holographic'"):
        type(make(task_id))(render_mode="holographic")


@every_task
def test_a_state_of_the_wrong_size_is_refused(task_id: str) -> None:
    env = make(task_id)
    nq, nv = env.model.nq, env.model.nv
    for qpos, qvel in ((nq + 1, nv), (nq, nv + 1), (1, 1)):
        with pytest.raises(ValueError, match=rf"must have shapes \({nq},\) and \({nv},\), got \({qpos},\) and \({qvel},\)"):
            env.set_state(np.zeros(qpos), np.zeros(qvel))


@every_task
def test_an_action_of_the_wrong_shape_is_refused(task_id: str) -> None:
    env = make(task_id)
    env.reset(seed=0)
    for shape in ((7,), (1, *env.action_space.shape)):
        with pytest.raises(ValueError, match=r"`action` must have shape \(.*\), got \("):
            env.step(np.zeros(shape, np.float32))


def test_a_model_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="`model_path` must be an MJCF file, but there is none at"):
        MujocoTask(tmp_path / "none.xml")


@pytest.mark.parametrize("frame_skip", [0, -1, 1.5])
def test_a_frame_skip_that_is_no_positive_whole_number_is_refused(frame_skip: Any) -> None:
    path = Path(mujoco.__file__)
    with pytest.raises(ValueError, match="`frame_skip` must be a whole number of at least 1"):
        MujocoTask(path, frame_skip)


def test_an_actuator_without_a_range_has_none(tmp_path: Path) -> None:
    """MuJoCo's own range is then [0, 0], which would cut every action to nothing."""
    (tmp_path / "model.xml").write_text("""
        <mujoco><worldbody><body><joint name="j" type="slide"/><geom size="0.1"/></body></worldbody>
        <actuator><motor joint="j"/><motor joint="j" ctrlrange="-2 1"/></actuator></mujoco>""")
    task = MujocoTask(tmp_path / "model.xml")
    np.testing.assert_array_equal(task.action_space.low, [-np.inf, -2.0])
    np.testing.assert_array_equal(task.controls(np.array([[70.0, 70.0]])), [[70.0, 1.0]])


# Pictures


def test_pictures_show_something_and_have_the_size_asked_for() -> None:
    code = """
        import gymnasium as gym
        from sb3_gae.envs import TASKS
        for task_id in TASKS:
            env = gym.make(task_id, render_mode="rgb_array", width=96, height=64)
            env.reset(seed=0)
            first = env.render()
            for _ in range(10):
                env.step(env.action_space.sample())
            second = env.render()
            print(task_id, *first.shape, first.dtype, first.std() > 5, (first != second).any())
            env.close()
            env.close()
        """
    words = run_headless(code)
    assert words == [word for task_id in TASKS for word in (task_id, "64", "96", "3", "uint8", "True", "True")]


@every_task
def test_for_people_each_state_is_shown(task_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = []

    class Window:
        def __init__(self, model: Any, data: Any, **kwargs: Any):
            self.data = data

        def render(self, mode: str) -> None:
            shown.append((mode, self.data.time))

    monkeypatch.setattr("sb3_gae.envs.mujoco_env.MujocoRenderer", Window)
    env = make(task_id, render_mode="human")
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    assert [mode for mode, _ in shown] == ["human"] * 4
    np.testing.assert_allclose([time for _, time in shown], env.dt * np.arange(4))


@every_task
def test_nothing_is_rendered_without_a_render_mode(task_id: str) -> None:
    env = make(task_id)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="`render_mode`"):
        assert env.render() is None
    env.close()
