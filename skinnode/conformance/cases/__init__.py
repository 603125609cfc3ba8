"""The cases, a module an area, in the order of the plan."""

from skinnode.conformance.cases import od, sdo, sdo_block, sheet

AREAS = (sheet, sdo, sdo_block, od)
