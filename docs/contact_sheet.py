"""
Draws docs/images/contact_sheet.png: frames of trained agents on the paper's tasks, at even intervals of an episode.

    MUJOCO_GL=egl python docs/contact_sheet.py --folder logs/paper_tasks   # after benchmarks/paper_tasks.py
"""

import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_gae.envs
from sb3_gae import TRPOGAE

SHEET = Path(__file__).parent / "images" / "contact_sheet.png"
SIZE, FRAMES, LABEL_HEIGHT = 240, 6, 18
# Seconds of an episode that are shown: a stride or two, and the whole of getting up
SECONDS = {"GaeCartPole-v0": 2.0, "GaeBiped-v0": 1.0, "GaeQuadruped-v0": 1.5, "GaeBipedStandup-v0": 4.0}
START = {"GaeBiped-v0": 3.0, "GaeQuadruped-v0": 3.0}


def frames(task: str, agent: Path) -> list[tuple[float, np.ndarray]]:
    """:return: time in seconds and picture of each frame"""
    model = TRPOGAE.load(agent / f"{task}.zip", device="cpu")
    env = gym.make(task, render_mode="rgb_array", width=SIZE, height=SIZE)
    statistics = agent / task / "vecnormalize.pkl"
    normalize = VecNormalize.load(str(statistics), DummyVecEnv([lambda: env])) if statistics.exists() else None
    observation, _ = env.reset(seed=0)
    dt = env.unwrapped.dt  # type: ignore[attr-defined]
    start, end = START.get(task, 0.0), START.get(task, 0.0) + SECONDS[task]
    wanted = {round(second / dt) for second in np.linspace(start, end, FRAMES)}
    pictures = []
    for step in range(max(wanted) + 1):
        if step in wanted:
            pictures.append((step * dt, np.asarray(env.render())))
        seen = normalize.normalize_obs(observation) if normalize else observation
        action, _ = model.predict(seen, deterministic=True)  # type: ignore[arg-type]
        observation, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            raise RuntimeError(f"{task} ended after {step * dt:.1f} s; take another agent.")
    env.close()
    return pictures


def sheet(rows: dict[str, list[tuple[float, np.ndarray]]]) -> Image.Image:
    image = Image.new("RGB", (FRAMES * SIZE, len(rows) * (SIZE + LABEL_HEIGHT)), "white")
    draw = ImageDraw.Draw(image)
    for row, (task, pictures) in enumerate(rows.items()):
        top = row * (SIZE + LABEL_HEIGHT)
        for column, (second, picture) in enumerate(pictures):
            text = f"{second:.2f} s" if column else f"{task}, {second:.2f} s"
            draw.text((column * SIZE + 4, top + 3), text, fill="black")
            image.paste(Image.fromarray(picture), (column * SIZE, top + LABEL_HEIGHT))
    return image


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("logs/paper_tasks"), help="where the agents are")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    agents = {task: args.folder / f"{task}-seed{args.seed}" / "trpo_gae" / f"{task}_1" for task in sb3_gae.envs.TASKS}
    rows = {task: frames(task, agent) for task, agent in agents.items() if agent.is_dir()}
    SHEET.parent.mkdir(exist_ok=True)
    sheet(rows).save(SHEET, optimize=True)
    print(f"wrote {SHEET} with {', '.join(rows)}")


if __name__ == "__main__":
    main()
