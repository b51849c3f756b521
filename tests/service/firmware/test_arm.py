"""The firmware's C gives the same bits on a microcontroller's processor as here, where `double` is software."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from aeroloop.protocol.wire.spec import SignalSpec, WireSpec
from aeroloop.service.config import Settings
from aeroloop.service.firmware.configuration import config_header
from aeroloop.service.firmware.machines import EXACT
from tests.support.firmware import COMPILERS, SOURCE

NEEDED = ("arm-none-eabi-gcc", "qemu-arm")
MAIN = r"""
#include <math.h>
#include <stdio.h>
#include <string.h>
#include "aero_node.h"
#include "aero_port.h"
static uint64_t seed = 1, digest = 14695981039346656037U;
static int64_t now = 1;
static double q[4], w[3];
static uint8_t counter, waiting, data[64];
static uint32_t id;
static aero_node node;
static uint32_t draw(void) { seed = seed * 6364136223846793005U + 1442695040888963407U; return (uint32_t)(seed >> 33); }
static double within(double a) { return a * ((double)draw() / 1073741824.0 - 1.0); }
static void note(const void *at, size_t size)
{
    for (const uint8_t *byte = at; size--; byte++) { digest = (digest ^ *byte) * 1099511628211U; }
}
int64_t aero_port_now(void) { return now; }
void aero_port_actuate(int64_t k, const double v[AERO_ACTUATORS]) { note(&k, sizeof k); note(v, sizeof node.voltages); }
void aero_port_enable(int on) { note(&on, sizeof on); }
void aero_port_measure(int64_t k, double a[4], double r[3]) { (void)k; memcpy(a, q, sizeof q); memcpy(r, w, sizeof w); }
void aero_port_send(uint32_t to, const uint8_t *bytes, size_t size)
{
    note(&to, sizeof to);
    note(bytes, size);
    if (to == 0x100 + AERO_CAN_NODE) { counter = bytes[0]; }
}
int aero_port_receive(uint32_t *from, uint8_t bytes[64], size_t *size)
{
    *from = id;
    *size = waiting;
    memcpy(bytes, data, sizeof data);
    waiting = 0;
    return *size > 0;
}
int main(void)
{
    static const uint8_t mark[] = AERO_FINGERPRINT;
    const aero_quantizer *signals[] = {&aero_attitude, &aero_rate, &aero_voltage};
    double held = NAN, level, codes[AERO_ACTUATORS];
    for (int i = 0; i < 100000; i++) {
        const aero_quantizer *signal = signals[i / 40000];
        double edge = (double)(draw() % 600) * signal->step / 2 - 150 * signal->step;
        held = aero_encode(signal, i % 3 ? within(1.3 * signal->limit) : edge, i % 40000 ? held : NAN);
        level = aero_level(signal, held);
        note(&held, sizeof held);
        note(&level, sizeof level);
    }
    aero_start(&node);
    for (int64_t k = 0; k < 20000; k++) {
        now += AERO_PERIOD_NS;
        double sine = k % 997 ? within(0.4) : 0.9;
        q[0] = sqrt(1 - sine * sine);
        q[1] = sine;
        for (int i = 0; i < 3; i++) { w[i] = k % 1501 ? within(0.7) : NAN; }
        if (k % 40 == 0) {
            id = 0x380 + AERO_CAN_NODE;
            data[0] = (uint8_t)((k / 1000 % 16) << 4 | AERO_GRANTED);
            memcpy(data + 1, mark, sizeof mark);
            waiting = AERO_HEARTBEAT_BYTES;
        } else if (draw() % 10) {
            id = 0x200 + AERO_CAN_NODE;
            for (int i = 0; i < AERO_ACTUATORS; i++) { codes[i] = aero_encode(&aero_voltage, within(24), NAN); }
            aero_pack_command(data, counter, codes);
            waiting = AERO_COMMAND_BYTES;
        }
        aero_poll(&node);
        aero_tick(&node, k);
        note(&node.state, sizeof node.state);
    }
    printf("%016llx\n", (unsigned long long)digest);
    return 0;
}
"""


@pytest.mark.skipif(
    not COMPILERS or not all(map(shutil.which, NEEDED)), reason=f"needs {' and '.join(NEEDED)}, and a compiler for here"
)
@pytest.mark.realtime  # no need of real time; another processor
@pytest.mark.parametrize("floats", ["soft", "hard"])
def test_quantizers_and_node_give_the_same_bits_on_arm_as_here(floats: str, tmp_path: Path) -> None:
    """By a digest over 100 000 codes and levels, and all that the node does in 20 000 ticks."""
    attitude = SignalSpec(bits=8, limit=1.0, kind="hysteresis-uniform")
    rate = SignalSpec(bits=9, limit=1.0, kind="logarithmic-uniform")
    (tmp_path / "aero_config.h").write_text(config_header(Settings(wire=WireSpec(attitude=attitude, rate=rate))))
    (tmp_path / "main.c").write_text(MAIN)
    core = "-march=armv7-a" if floats == "soft" else "-march=armv7-a+vfpv3-d16"
    arm = [core, f"-mfloat-abi={floats}", "--specs=rdimon.specs", "-Os"]
    digests = []
    for compiler, flags, runner in ((COMPILERS[0], ["-O1"], []), (NEEDED[0], arm, [NEEDED[1]])):
        program = tmp_path / compiler
        words = ["-std=c99", *EXACT, f"-I{tmp_path}", f"-I{SOURCE}", "-o", str(program), "main.c"]
        sources = [str(SOURCE / f"aero_{part}.c") for part in ("wire", "node")]
        subprocess.run([compiler, *flags, *words, *sources, "-lm"], cwd=tmp_path, check=True)
        done = subprocess.run([*runner, str(program)], capture_output=True, text=True, check=True)
        digests.append(done.stdout)
    assert len(digests[0].strip()) == 16
    assert digests[0] == digests[1]
