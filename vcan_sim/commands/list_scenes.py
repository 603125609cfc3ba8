"""``vcan-sim list``: list the scenes that come with the simulator."""

from __future__ import annotations


def list_scenes() -> None:
    """List the scenes that come with the simulator, for use with `vcan-sim run --scene NAME`.

    A scene can be played on any hand that has all patches named in the scene.
    """
    from vcan_sim.scenes.library import shipped_scenes
    from vcan_sim.scenes.tables import read_scene

    for name, path in shipped_scenes().items():
        scene = read_scene(path)
        places = dict.fromkeys(
            [touch.patch for touch in scene.touches] + [each.where for each in scene.faults]
        )
        print(f"{name:<10} {scene.name}; on {', '.join(places)}", flush=True)
