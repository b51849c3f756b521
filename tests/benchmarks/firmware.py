"""What the exported controller takes on a Cortex-M4F: `uv run python -m tests.benchmarks.firmware [--config FILE]`.

Sizes are of -Os objects. The worst stack follows gcc's call graph; what it calls of libgcc and libm is not in it. A
tick's instructions are counted by QEMU, one nanosecond each, over the golden ticks. Then the same with the law in
single precision, which is another law: how many of the experiment's commands it changes when it receives the same
measurements, how far its voltages are off before quantization, and what a certificate says with that error.
"""

from __future__ import annotations

import argparse
import re
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import casadi as ca
import numpy as np

from aeroloop.service.config import Settings, load
from aeroloop.service.firmware.export import equations, export, expression_law
from aeroloop.service.firmware.machines import EXACT, MACHINES, Program
from aeroloop.service.firmware.script import ScriptedController, answers_in
from aeroloop.service.lab.experiment import experiment
from aeroloop.service.theorem.certificate import certify

PARTS: Final = {"wire": "aero_wire", "law": "aero_law", "equations": "aero_equations", "node": "aero_node"}
COUNTER: Final = """
#include <stdint.h>
#include <stdio.h>
#define SYSTICK ((volatile uint32_t *)0xE000E010)
extern uint32_t counted; uint32_t counted;
#include "aero_law.h"
int __real_aero_law_tick(aero_law *law, const uint8_t *frame, size_t size, int64_t k, uint8_t *command);
int __wrap_aero_law_tick(aero_law *law, const uint8_t *frame, size_t size, int64_t k, uint8_t *command) {
    SYSTICK[1] = 0xFFFFFF; SYSTICK[2] = 0; SYSTICK[0] = 5;
    int length = __real_aero_law_tick(law, frame, size, k, command);
    counted += 0xFFFFFF - SYSTICK[2];
    if (k % 1000 == 999) printf("counted %lu over %ld\\n", (unsigned long)counted, (long)k + 1);
    return length;
}
"""
"""Counts SysTick's periods, of 40 ns at 25 MHz, within the calls."""
IN_SINGLE: Final = """
#include <math.h>
#include <stddef.h>
#include "aero_wire.h"
const uint64_t aero_equations_config = AERO_CONFIG;
int single(const float **, float **, long long int *, float *, int);
int aero_equations(const double **arguments, double **results, long long int *indices, double *scratch, int memory) {
    static const size_t of_in[] = {%s}, of_out[] = {%s};
    static float values[2][sizeof of_in / sizeof *of_in + sizeof of_out / sizeof *of_out][64], work[%d];
    const float *given[%d]; float *found[%d];
    (void)scratch; (void)memory;
    for (size_t i = 0; i < sizeof of_in / sizeof *of_in; i++) {
        for (size_t j = 0; j < of_in[i]; j++) values[0][i][j] = (float)arguments[i][j];
        given[i] = values[0][i];
    }
    for (size_t i = 0; i < sizeof of_out / sizeof *of_out; i++) found[i] = values[1][i];
    int failed = single(given, found, indices, work, 0);
    for (size_t i = 0; i < sizeof of_out / sizeof *of_out; i++)
        for (size_t j = 0; j < of_out[i]; j++) results[i][j] = (double)values[1][i][j];
    return failed;
}
"""


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path)
    settings = load(parser.parse_args().config)
    with TemporaryDirectory() as name:
        export(settings, Path(name, "c"))
        sizes(Path(name, "c"))
        print(f"\ninstructions a tick: {instructions(Path(name, 'c')):,.0f}")
        in_single_precision(settings, Path(name, "single"))


def sizes(folder: Path) -> None:
    """Print code, constants, data and worst stack of each part [bytes]."""
    arm = MACHINES["cortex-m4"]
    print("| part | code | constants | RAM | worst stack |\n|---|--:|--:|--:|--:|")
    stacks, calls = dict[str, int](), dict[str, set[str]]()
    for part, name in PARTS.items():
        if not (folder / f"{name}.c").exists():
            continue
        flags = [
            "-std=c99",
            "-Os",
            *EXACT,
            "-ffunction-sections",
            "-fdata-sections",
            "-w",
            "-fcallgraph-info=su",
        ]
        subprocess.run([arm.compiler, *arm.flags, *flags, "-c", f"{name}.c"], cwd=folder, check=True)
        graph = (folder / f"{name}.ci").read_text()
        mine = {_bare(title): int(size) for title, size in re.findall(r'title: "([^"]+)".*?\\n(\d+) bytes', graph)}
        stacks |= mine
        for source, target in re.findall(r'sourcename: "([^"]+)" targetname: "([^"]+)"', graph):
            calls.setdefault(_bare(source), set()).add(_bare(target))
        command = [arm.compiler.replace("gcc", "size"), "-A", f"{name}.o"]
        listed = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
        section = dict.fromkeys(("text", "rodata", "data", "bss"), 0)
        for kind, size in re.findall(r"^\.(\w+)\S*\s+(\d+)", listed.stdout, re.MULTILINE):
            if kind in section:
                section[kind] += int(size)
        worst = max(_stack(function, stacks, calls) for function in mine)
        print(f"| {part} | {section['text']} | {section['rodata']} | {section['data'] + section['bss']} | {worst} |")


def _bare(title: str) -> str:
    return title.rpartition(":")[2]


def _stack(function: str, stacks: dict[str, int], calls: dict[str, set[str]]) -> int:
    below = [_stack(each, stacks, calls) for each in calls.get(function, ()) if each != function]
    return stacks.get(function, 0) + max(below, default=0)


def instructions(folder: Path) -> float:
    """Instructions of a tick on a Cortex-M4F, the mean of the golden ones."""
    (folder / "counter.c").write_text(COUNTER)
    arm = MACHINES["cortex-m4"]
    flags = [*arm.flags, "-std=gnu99", "-Os", *EXACT, "-w", "-Wl,--wrap=aero_law_tick"]
    sources = ["counter.c", "test_golden.c", "aero_wire.c", "aero_law.c", "aero_equations.c", "cortex_m.c"]
    link = ["--specs=rdimon.specs", "-Tcortex_m.ld", "-o", "counted", "-lm"]
    subprocess.run([arm.compiler, *flags, *sources, *link], cwd=folder, check=True)
    command = [*arm.start, "counted", "-icount", "shift=0"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    found = re.search(r"counted (\d+) over (\d+)", done.stdout)
    assert found is not None, done.stdout
    return 40 * int(found[1]) / int(found[2])


def in_single_precision(settings: Settings, folder: Path) -> None:
    """Print what a law in single precision would change."""
    export(settings, folder)
    function = equations(expression_law(settings))
    single = ca.Function("single", function.sx_in(), function.call(function.sx_in()), {"cse": True})
    generator = ca.CodeGenerator("single.c", {"casadi_real": "float", "casadi_int": "long long int"})
    generator.add(single)
    source = Path(generator.generate(f"{folder}/")).read_text()
    of_in = ",".join(str(function.numel_in(i)) for i in range(function.n_in()))
    of_out = ",".join(str(function.numel_out(i)) for i in range(function.n_out()))
    wrapper = IN_SINGLE % (of_in, of_out, max(1, single.sz_w()), single.sz_arg(), single.sz_res())
    (folder / "aero_equations.c").write_text(source + wrapper)
    controller = ScriptedController(settings.wire, settings.law, settings.reference, settings.loop.period)
    voltages = experiment(settings, 50.0, controller=controller).course.voltages
    found, _ = answers_in(Program(folder, "host").answers(bytes(controller.script)))
    expected, _ = answers_in(bytes(controller.answers) + bytes(8))
    differ = sum(mine != other for mine, other in zip(found, expected, strict=True))
    level, unpack = settings.wire.voltage.quantizer().level, settings.wire.command.unpack
    off = 0.0
    for mine, volts in zip(found, voltages.tolist(), strict=True):
        read = unpack(mine) if mine else None
        if read is not None:
            off = max(off, *(abs(level(code) - volt) for code, volt in zip(read[1], volts, strict=True)))
    print(f"single precision: {differ} of {len(found)} commands differ in 50 s, by at most {off:.3g} V")
    added = float(np.linalg.norm(np.array(settings.law.allocation), 2)) * off
    for what, certificate in (("double", certify(settings)), ("single", certify(settings, disturbance=added))):
        print(f"{what}: {certificate.verdict}")


if __name__ == "__main__":
    main()
