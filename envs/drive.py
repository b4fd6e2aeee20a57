"""Drive the robot with the arrow keys: ``python -m halgan_envs.drive --environment navigate-2m``."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import tyro

from .adapters.transition import read
from .environment import Environment
from .suite.names import named


class ArrowKeys:
    """The keys that are held down, by matplotlib's key events, and the action that the arrows stand for."""

    def __init__(self) -> None:
        self._held: set[str] = set()

    def press(self, event: Any) -> None:
        """Notes a key."""
        self._held.add(event.key)

    def release(self, event: Any) -> None:
        """Forgets a key."""
        self._held.discard(event.key)

    def action(self, robot: Any) -> Any:
        """Returns an action: up and down drive at full speed, left and right turn at the full rate, no key is a halt.

        Without a reverse gear, down is a halt too.

        Args:
            robot: The robot that acts.

        Returns:
            The action; None if the keys mean a halt and the robot has no action for it.
        """
        forward, turn = self._axis("up", "down"), self._axis("left", "right")
        speed = forward * (robot.max_speed if forward > 0 else robot.reverse_speed)
        action = robot.action_for(speed, turn * robot.max_turn_rate)
        halts = np.allclose(robot.velocities(action), 0.0)
        return action if speed or turn or halts else None

    def _axis(self, positive: str, negative: str) -> int:
        return (positive in self._held) - (negative in self._held)


class Cockpit:
    """A figure with the robot's image and the room from outside, in which keys drive and episodes follow each other."""

    def __init__(self, environment: Environment) -> None:
        self._environment = environment
        self._keys = ArrowKeys()
        self._is_shown = False
        self.figure, self._axes = plt.subplots(1, 2, figsize=(10, 4.5))
        self.figure.canvas.mpl_connect("key_press_event", self._keys.press)
        self.figure.canvas.mpl_connect("key_release_event", self._keys.release)

    def tick(self) -> None:
        """Takes a step, or starts the next episode after an end, and shows where it led.

        A robot that cannot halt waits for a key.
        """
        task = self._environment.task
        action = self._keys.action(task.robot)
        if action is None and self._is_shown:
            return
        self._is_shown = True
        transition = read(self._environment.step(action))
        for axes, image in zip(self._axes, (transition.pixels, self._environment.render_overview()), strict=True):
            axes.clear()
            axes.imshow(image)
            axes.set_axis_off()
        state = "reached!" if transition.terminated else "time is over" if transition.truncated else "arrow keys drive"
        self.figure.suptitle(f"{task.mission}: {state}")
        self.figure.canvas.draw_idle()


def main(environment: str = "navigate-2m") -> None:
    """Drives a robot with the arrow keys until the window is closed; environment is one of ``halgan_envs.NAMES``."""
    # Free the arrow keys, which matplotlib takes for back and forward in the history of views.
    plt.rcParams.update({"keymap.back": [], "keymap.forward": []})
    room = named(environment)()
    cockpit = Cockpit(room)
    if not getattr(cockpit.figure.canvas, "required_interactive_framework", None):
        raise RuntimeError(
            f"matplotlib's backend {plt.get_backend()!r} opens no window: drive where there is a display."
        )
    timer = cockpit.figure.canvas.new_timer(interval=round(1000 * room.task.control_timestep))
    timer.add_callback(cockpit.tick)
    timer.start()
    plt.show()
    room.close()


if __name__ == "__main__":
    tyro.cli(main)
