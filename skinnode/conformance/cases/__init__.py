"""Conformance cases, one module per area, in the order of the test plan."""

from skinnode.conformance.cases import (
    eds,
    emcy,
    guarding,
    heartbeat,
    heartbeat_or_guarding,
    od,
    others,
    pdo,
    pdo_mapping,
    sdo,
    sdo_block,
    states,
    sync,
    transitions,
)

AREAS = (
    eds,
    sdo,
    sdo_block,
    pdo,
    pdo_mapping,
    od,
    emcy,
    sync,
    guarding,
    heartbeat,
    heartbeat_or_guarding,
    others,
    states,
    transitions,
)
