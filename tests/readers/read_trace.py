"""Reads the ticks of both ends of a log, and computes z_track of (C.81) by SPEC.md alone: for the default's wire."""

import sys

import numpy as np
from mcap.reader import make_reader

PERIOD, LEVEL = 0.002, 2 / 255
AMPLITUDE, FREQUENCY = np.radians([[0], [40], [100]]), np.pi * np.array([0, 0.1, 0.05])
ROWS = {
    "controller": "tick:u4 received_as:u1 sent_as:u1 received:u4 sent:u4 measurement:V7",
    "plant": "tick:u8 session_tick:u4 sent_as:u1 received_as:u1 outcome:u1 trip:u1 answered:u4 sent:u4 received:u4 "
    "measurement:V7",
}
measured: dict[str, dict[int, bytes]] = {"controller": {}, "plant": {}}
with open(sys.argv[1], "rb") as file:
    for _schema, channel, message in make_reader(file).iter_messages():
        _, kind, end = channel.topic.rsplit("/", 2)
        if kind == "trace":
            n, at, columns = int.from_bytes(message.data[8:12], "little"), 112, {}
            for name, dtype in (column.split(":") for column in ROWS[end].split()):
                columns[name] = np.frombuffer(message.data, np.dtype(dtype).newbyteorder("<"), n, at)
                at += columns[name].nbytes
            ticks = np.add.accumulate(columns["tick" if end == "controller" else "session_tick"], dtype="u4")
            measured[end] |= zip(ticks.tolist(), columns["measurement"].tolist(), strict=True)

k = np.array(sorted(measured["controller"]))
codes = np.array([list(measured["controller"][tick]) for tick in k.tolist()], dtype="u1").view("i1")[:, 1:4]
eps = codes.T * LEVEL
square = (eps**2).sum(axis=0)
q = np.array([np.sqrt(np.maximum(0, 1 - square)), *(eps / np.sqrt(np.maximum(1, square)))])
half = AMPLITUDE * np.sin(np.outer(FREQUENCY, k * PERIOD)) / 2
(a, b, c), (x, y, z) = np.cos(half), np.sin(half)
desired = [a * b * c + x * y * z, x * b * c - a * y * z, a * y * c + x * b * z, a * b * z - x * y * c]
cosine = (q * desired).sum(axis=0)  # of half the error's angle, so ε̃ᵀε̃ is 1 − cosine²
z_track = ((1 - cosine**2) * np.diff(k, append=k[-1] + 1) * PERIOD).sum()
sys.stdout.write(f"{len(k)} {len(measured['plant'])} {float(z_track)!r}\n")
