"""Lockstep HIL test: what the loop does when a sensor fails, on real processes, the same on every machine.

pytest --hil-lockstep test_lockstep_hil.py
"""

from aeroloop import Hil


def test_a_dead_gyro_brings_the_motors_to_rest(hil: Hil) -> None:
    hil.start()
    hil.run(2)
    hil.inject("rate:off")
    hil.run(1)
    assert hil.log.trips == ["the sensors have had no valid value for 102 ms: 0 V"]
    assert hil.log.figures.z_track < 50e-4
