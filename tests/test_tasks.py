"""The paper's tasks: what the paper says of them, on every one."""

import math
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium import spaces
from task_facts import (
    FACTS,
    LOCOMOTION,
    Facts,
    every_task,
    make,
    random_action,
)

from sb3_gae.envs import TASKS, MujocoTaskEnv, register_tasks


def test_every_task_is_checked() -> None:
    assert FACTS.keys() == TASKS.keys()
    register_tasks()  # again


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
