"""Runs functions of a Cortex-M0+ program and counts their cycles.

Cycle counts follow the technical reference manual (Arm DDI 0484C, table 3-1), without wait states and with
the single-cycle multiplier.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import unicorn
from unicorn import arm_const

FLASH, FLASH_BYTES = 0x10000, 0x40000
RAM, RAM_BYTES = 0x2000_0000, 0x40000
STACK = RAM + RAM_BYTES
RETURN = 0x7000_0000


class CortexM0:
    """Emulator of a Cortex-M0+ that runs a program.

    Args:
        elf: Program linked to :data:`FLASH` and :data:`RAM`, without initialised data.
    """

    def __init__(self, elf: Path) -> None:
        image = elf.with_suffix(".bin")
        subprocess.run(["arm-none-eabi-objcopy", "-O", "binary", elf, image], check=True)
        listed = subprocess.run(["arm-none-eabi-nm", elf], capture_output=True, text=True, check=True).stdout
        symbols = re.findall(r"^(\w+) \w (\S+)$", listed, re.MULTILINE)
        self._symbols = {name: int(at, 16) for at, name in symbols}
        self._machine = unicorn.Uc(unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB | unicorn.UC_MODE_MCLASS)
        self._machine.ctl_set_cpu_model(arm_const.UC_CPU_ARM_CORTEX_M0)
        for at, size in ((FLASH, FLASH_BYTES), (RAM, RAM_BYTES), (RETURN, 0x1000)):
            self._machine.mem_map(at, size)
        self._machine.mem_write(FLASH, image.read_bytes())
        self._machine.hook_add(unicorn.UC_HOOK_CODE, self._on_instruction)
        self._cycles = self._lowest = 0
        self._branch_from: int | None = None

    def call(self, function: str) -> tuple[int, int]:
        """Call a function without arguments; return its cycle count and its stack use in bytes."""
        self._cycles, self._lowest, self._branch_from = 0, STACK, None
        self._machine.reg_write(arm_const.UC_ARM_REG_SP, STACK)
        self._machine.reg_write(arm_const.UC_ARM_REG_LR, RETURN | 1)
        self._machine.emu_start(self._symbols[function] | 1, RETURN)
        return self._cycles, STACK - self._lowest

    def word(self, symbol: str, offset: int) -> int:
        """Return a 32-bit word of a variable."""
        return int.from_bytes(self._machine.mem_read(self._symbols[symbol] + offset, 4), "little")

    def _on_instruction(self, machine: unicorn.Uc, at: int, size: int, _: object) -> None:
        if self._branch_from is not None and at != self._branch_from + 2:
            self._cycles += 1  # the conditional branch was taken
        self._branch_from = None
        self._lowest = min(self._lowest, machine.reg_read(arm_const.UC_ARM_REG_SP))
        code = int.from_bytes(machine.mem_read(at, 2), "little")
        if size == 4:
            self._cycles += 3  # BL; barriers and MRS take the same time
            return
        if code >> 12 == 0b1101:
            self._branch_from = at
        self._cycles += cycles_of(code)


def cycles_of(code: int) -> int:
    """Return the cycle count of a 16-bit instruction; a conditional branch counts as not taken."""
    top = code >> 11
    if code >> 9 in (0b1011010, 0b1011110):  # PUSH, POP
        registers = (code & 0xFF).bit_count()
        if code >> 8 == 0b10111101:  # with the program counter
            return 3 + registers
        return 1 + registers + (code >> 8 & 1)
    if code >> 12 == 0b1100:  # LDM, STM
        return 1 + (code & 0xFF).bit_count()
    if code >> 12 in (0b0101, 0b0110, 0b0111, 0b1000, 0b1001) or top == 0b01001:  # loads and stores
        return 2
    if top == 0b11100 or code >> 7 in (0b010001110, 0b010001111):  # B, BX, BLX
        return 2
    if code >> 8 in (0b01000100, 0b01000110) and code & 0x87 == 0x87:  # ADD, MOV to the program counter
        return 2
    return 1
