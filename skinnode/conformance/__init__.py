"""A conformance suite for CANopen nodes: 127 cases in raw frames, for any node on any interface.

Data flows from ``eds_reader`` (what the device promises) and ``tester`` (frames, one case at a time) through
``sdo`` and ``dut`` (the device under test) to the cases, and from ``run`` (each case after a reset,
configuration put back) to ``report`` and ``html_report``.

The suite knows a node by its EDS and by its frames. Its tester, SDO client, EDS reader and constants are its
own on purpose: code shared with the node would repeat the node's errors.
"""

from skinnode.conformance.case import Case, NotApplicable, Result, Verdict
from skinnode.conformance.dut import Dut
from skinnode.conformance.eds_reader import Eds, parse_eds, parse_eds_file
from skinnode.conformance.run import Report, connect, run_case, run_cases
from skinnode.conformance.suite import CASES, select

__all__ = [
    "CASES",
    "Case",
    "Dut",
    "Eds",
    "NotApplicable",
    "Report",
    "Result",
    "Verdict",
    "connect",
    "parse_eds",
    "parse_eds_file",
    "run_case",
    "run_cases",
    "select",
]
