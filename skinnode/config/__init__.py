"""Reads the configuration of a hand from ``hand.toml``; each table of the file has its own module.

::

    file -> toml_text (values, positions) -> hand, buses, patches, links, running, simulation (pydantic
    models)
         -> HandConfig, or explain (one-line errors)

:func:`load_hand` reads a file, and :func:`parse_hand` validates a table in memory. Both raise
:class:`~skinnode.errors.ConfigError` with a one-line message that contains the file, line and column, dotted
key, value found and values allowed. Values must have the right TOML type, because they are not converted:
``node_id = "3"`` is an error.

``schema`` generates the JSON Schema. ``descriptions`` reads the descriptions of keys from the source code.

The suffix of a key indicates the unit. The value of a key without such a suffix is a count, a ratio or a
name.
"""

from skinnode.config.buses import (
    MAX_BUS_LOAD,
    BringUpConfig,
    BusConfig,
    Missing,
    OtherFrame,
    SyncConfig,
)
from skinnode.config.hand import HandConfig, load_hand, parse_hand
from skinnode.config.links import LinkConfig, PoseConfig
from skinnode.config.patches import (
    CalibrationConfig,
    LayoutConfig,
    PatchConfig,
    load_layout,
)
from skinnode.config.running import Partial, SolverConfig, StreamConfig
from skinnode.config.simulation import SimulationConfig

__all__ = [
    "MAX_BUS_LOAD",
    "BringUpConfig",
    "BusConfig",
    "CalibrationConfig",
    "HandConfig",
    "LayoutConfig",
    "LinkConfig",
    "Missing",
    "OtherFrame",
    "Partial",
    "PatchConfig",
    "PoseConfig",
    "SimulationConfig",
    "SolverConfig",
    "StreamConfig",
    "SyncConfig",
    "load_hand",
    "load_layout",
    "parse_hand",
]
