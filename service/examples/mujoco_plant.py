"""Your own MuJoCo model as the plant: a satellite on three reaction wheels, behind the paper's law, in lockstep.

pip install 'aeroloop[mujoco]'
python mujoco_plant.py [seconds]
"""

from __future__ import annotations

import sys

import aeroloop

# Instead of this text, `plant.own.model` may be the path of an MJCF file.
SATELLITE = """
<mujoco>
  <option gravity="0 0 0" timestep="0.002" integrator="implicitfast"/>
  <default><joint damping="2e-6"/><motor gear="-0.001" ctrlrange="-24 24"/></default>
  <worldbody>
    <body name="bus">
      <freejoint/>
      <inertial pos="0 0 0" mass="4" diaginertia="0.05 0.05 0.03"/>
      <body><joint name="x" axis="1 0 0"/><inertial pos="0.1 0 0" mass="0.1" diaginertia="4e-5 2e-5 2e-5"/></body>
      <body><joint name="y" axis="0 1 0"/><inertial pos="0 0.1 0" mass="0.1" diaginertia="2e-5 4e-5 2e-5"/></body>
      <body><joint name="z" axis="0 0 1"/><inertial pos="0 0 0.1" mass="0.1" diaginertia="2e-5 2e-5 4e-5"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="x"/><motor joint="y"/><motor joint="z"/></actuator>
</mujoco>
"""


def main(duration_s: float = 20.0) -> None:
    """Fly the reference with wires of several widths, and print a line for each."""
    for bits in (8, 10, 12):
        settings = aeroloop.load_settings(
            overrides={
                "plant": {"kind": "mujoco", "own": {"model": SATELLITE, "body": "bus"}},
                # What the controller assumes: the inertia without wheels, no weight, 1 mN·m a volt.
                "law": {
                    "inertia": (0.05, 0.05, 0.03),
                    "gravity": 0.0,
                    "allocation": ((0.001, 0, 0), (0, 0.001, 0), (0, 0, 0.001)),
                    "damping_estimate": (0, 0, 0),
                },
                "wire": {"actuators": 3, "attitude.bits": bits, "rate.bits": bits, "voltage.bits": bits},
                "reference": {"kind": "sinusoid", "amplitude": (60, 30, 100), "frequency": (0.1, 0.2, 0.15)},
            }
        )
        figures = aeroloop.run_experiment(settings, duration_s)
        assert figures.z_track is not None  # it is null only where nothing was measured
        print(f"{bits:2d} bits: z_track = {figures.z_track * 1e4:.1f} ×10⁻⁴ s, ", end="")
        print(f"error {figures.max_error_deg:.2f}° at the most, {figures.final_error_deg:.2f}° at the end")


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
