"""Runs conformance cases, each after a reset, and restores the configuration of the node."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from skinnode.canopen import indices as od
from skinnode.conformance.case import Case, NotApplicable, Result, Verdict, Warned
from skinnode.conformance.configuration import read_configuration, write_back
from skinnode.conformance.dut import Dut
from skinnode.conformance.eds_reader import Eds, parse_eds
from skinnode.conformance.sdo import SdoClient
from skinnode.conformance.tester import Failed, Tester
from skinnode.errors import BusError, ConfigError, NodeTimeout
from skinnode.process import clock
from skinnode.protocol.eds_files import eds_name, eds_text
from skinnode.protocol.profile import BusType, PatchProfile
from skinnode.transport import CanPort

SILENT_CASES: Final = 3
"""Number of consecutive cases with no response to the reset after which the remaining cases are skipped."""


@dataclass(frozen=True, slots=True)
class Report:
    """Results of a conformance run; ``problems`` lists failures to restore the node's configuration."""

    results: tuple[Result, ...]
    problems: tuple[str, ...]
    eds: str
    """File name or other origin of the EDS."""

    @property
    def failed(self) -> int:
        """Number of failed cases."""
        return self.count(Verdict.FAILED)

    def count(self, verdict: Verdict) -> int:
        """Return the number of cases with the given verdict."""
        return sum(result.verdict is verdict for result in self.results)


def connect(port: CanPort, node_id: int, eds: Eds | None = None) -> Dut:
    """Reset a node and return it as the device under test.

    Args:
        port: The bus.
        node_id: The node.
        eds: EDS of the node; not needed for a skinnode patch, whose EDS is generated from its descriptor
            (0x2000).

    Raises:
        NodeTimeout: The node does not answer.
        ConfigError: The node is not a skinnode patch, and no EDS is given.
    """
    bus = Tester(port)
    Dut(bus, node_id, _NO_EDS).prepare()
    return Dut(bus, node_id, eds if eds is not None else _own_eds(SdoClient(bus, node_id)))


_NO_EDS: Final = Eds("", {}, frozenset(), {}, ())


def _own_eds(sdo: SdoClient) -> Eds:
    try:
        product = sdo.integer(od.IDENTITY, od.IDENTITY_PRODUCT)
        if product == od.PRODUCT_CODE:
            sizes = (
                od.ROWS,
                od.COLUMNS,
                od.UPPER_ELECTRODES,
                od.LOWER_ELECTRODES,
                od.CODE_BITS,
                od.PDO_BYTES,
            )
            rows, columns, upper, lower, bits, pdo_bytes = (sdo.integer(od.DESCRIPTOR, sub) for sub in sizes)
            checked = sdo.integer(od.IDENTITY, od.IDENTITY_REVISION) > od.UNCHECKED_REVISION_NUMBER
            bus: BusType = "classic" if pdo_bytes == 8 else "fd"
            patch = PatchProfile(rows, columns, upper, lower, bits, bus=bus, checked=checked)
            return parse_eds(eds_text(patch), f"{eds_name(patch)}, generated")
    except Failed as failure:
        raise ConfigError(
            "--eds", "nothing", f"the device's EDS, because its identity is unknown: {failure}"
        ) from None
    raise ConfigError(
        "--eds", "nothing", f"the device's EDS, because 0x{product:08X} is not the product code of a patch"
    )


def run_cases(dut: Dut, cases: Iterable[Case], say: Callable[[Result], None] = lambda _: None) -> Report:
    """Run cases one after another.

    Every case has a result, even if the node misbehaves. After a case that stored or restored parameters, the
    original configuration of the node is restored. The node is reset at the end.

    Args:
        dut: The device.
        cases: The cases.
        say: Called with each result.

    Raises:
        BusError: The interface failed.
    """
    results: list[Result] = []
    problems: list[str] = []
    before = read_configuration(dut)
    silent = 0
    try:
        for case in cases:
            if silent == SILENT_CASES:
                why = f"not run: the node did not respond to resets in {SILENT_CASES} consecutive cases"
                result = Result(case, Verdict.FAILED, why)
            else:
                result = run_case(dut, case)
                silent = 0 if dut.up else silent + 1
            results.append(result)
            say(result)
            problems += _put_back(dut, before)
    finally:  # even if the user interrupts the run
        problems += _put_back(dut, before)
        if silent < SILENT_CASES:
            _reset(dut)
    return Report(tuple(results), tuple(dict.fromkeys(problems)), dut.eds.source)


def run_case(dut: Dut, case: Case) -> Result:
    """Reset the node and run one case."""
    begun_s = clock.monotonic()
    verdict, why = Verdict.PASSED, ""
    dut.bus.begin()
    try:
        dut.prepare()
        case.run(dut)
    except NotApplicable as reason:
        verdict, why = Verdict.NOT_APPLICABLE, str(reason)
    except Warned as doubt:
        verdict, why = Verdict.WARNING, str(doubt)
    except (Failed, NodeTimeout) as failure:
        verdict, why = Verdict.FAILED, str(failure)
    except BusError:
        raise
    except Exception as error:  # e.g. a response that the case could not decode
        verdict, why = Verdict.FAILED, f"unexpected response ({type(error).__name__}: {error})"
    return Result(case, verdict, why, clock.monotonic() - begun_s, dut.bus.trace)


def _put_back(dut: Dut, before: dict[tuple[int, int], bytes]) -> list[str]:
    if not dut.stored:
        return []
    try:
        dut.prepare()
        problems = write_back(dut, before)
    except (Failed, NodeTimeout) as failure:
        problems = [f"the configuration could not be restored: {failure}"]
    dut.stored = False  # not if the user interrupts the restoration, which is then repeated
    return problems


def _reset(dut: Dut) -> None:
    try:
        dut.prepare()
    except NodeTimeout:
        return
