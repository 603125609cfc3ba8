"""The cases, a module an area, in the order of the plan."""

from skinnode.conformance.cases import (
    emcy,
    guarding,
    heartbeat,
    od,
    others,
    pdo,
    pdo_mapping,
    sdo,
    sdo_block,
    sheet,
    states,
    sync,
    transitions,
    versus,
)

AREAS = (
    sheet,
    sdo,
    sdo_block,
    pdo,
    pdo_mapping,
    od,
    emcy,
    sync,
    guarding,
    heartbeat,
    versus,
    others,
    states,
    transitions,
)
