"""A recorded run as one HTML file that needs nothing else: no server, no network, no library."""

import html
import json
from pathlib import Path

from sb3_gae.lab.readings import light
from sb3_gae.lab.simulation import Simulation

_FOLDER = Path(__file__).parent


def recorded_run(simulation: Simulation, title: str) -> str:
    """
    :param simulation: whose steps so far are to be kept
    :param title: of the page
    :return: HTML with the grid, the curves and the log, and a slider and a play button to go through them
    """
    data = {
        "steps": [
            {
                "step": reading.step,
                "score": round(reading.score, 4),
                "angle": round(reading.bias_angle, 4) if reading.bias_angle == reading.bias_angle else None,
                "light": light(reading.bias_angle),
                "variance": float(f"{reading.variance:.4g}"),
                "values": frame.values.round(3).tolist(),
                "moves": frame.probabilities.round(3).tolist(),
            }
            for reading, frame in zip(simulation.readings, simulation.frames, strict=True)
        ],
        "events": [{"step": event.step, "text": event.text} for event in simulation.events],
    }
    # "</script>" in a string would end the script
    text = json.dumps(data, ensure_ascii=True, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    page = (_FOLDER / "recorded_run.html").read_text(encoding="utf-8")
    style = (_FOLDER / "style.css").read_text(encoding="utf-8")
    return page.replace("{{title}}", html.escape(title, quote=False)).replace("/*{{style}}*/", style).replace("{{data}}", text)
