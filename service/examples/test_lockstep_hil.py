"""Lockstep HIL test: what the loop does when a motor fails, on real processes, the same on every machine.

pytest --hil-lockstep test_lockstep_hil.py
"""

from __future__ import annotations

from aeroloop import Hil


def test_a_dead_motor_does_not_trip_the_plant(hil: Hil) -> None:
    """The pitch motor is off for half a second; the loop goes on and recovers."""
    hil.start()
    hil.run(0.5)  # in lockstep exactly 250 ticks, however busy the machine is
    hil.inject("motor1:off@0..0.5")  # times count from now
    hil.run(1.0)
    # Asking for the log ends the run. Everything is computed from the log alone.
    assert hil.log.trips == []
    assert hil.log.figures.max_error_deg < 10
