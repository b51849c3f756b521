"""Prometheus exporter for every vehicle on a network, `aeroloop op metrics`; `alerts.yml` has rules for its metrics.

Its values are those of each role's last status, and stay when a role falls silent: the age of the status says so.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from importlib.metadata import version
from math import inf
from typing import Final

import zenoh
from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily as Counter
from prometheus_client.core import GaugeMetricFamily as Gauge
from prometheus_client.core import HistogramMetricFamily, InfoMetricFamily, Metric
from prometheus_client.registry import Collector

from aeroloop.protocol.errors import AeroloopError
from aeroloop.protocol.messages import topics
from aeroloop.protocol.messages.models import LATENCY_BOUNDS_US, PROTOCOL_VERSION, Status, Telemetry
from aeroloop.protocol.messages.operator import MessageError
from aeroloop.protocol.messages.states import NOT_RECORDING, RECORDING, STOPPED, ControllerState, PlantState, TripCause
from aeroloop.protocol.transport.network import join
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wire.attitude import angle
from aeroloop.service.host.health import NEEDED, SILENT_S, replaces

_LABELS: Final = ("vehicle", "role")
_STATES: Final[dict[str, Iterable[str]]] = {
    "plant": PlantState, "controller": ControllerState, "recorder": (RECORDING, NOT_RECORDING, STOPPED)
}  # fmt: skip
_UPPER: Final = [*(str(bound / 1e6) for bound in LATENCY_BOUNDS_US), "+Inf"]  # of a histogram's buckets [s]


class MetricsError(AeroloopError):
    """The address or port cannot be listened on; one line."""


class Exporter(Collector):
    """Takes in statuses and telemetry, and gives Prometheus the metrics of the last ones."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._statuses: dict[tuple[str, str], tuple[float, Status]] = {}  # by vehicle and role, and when received
        self._telemetry: dict[str, tuple[float, Telemetry]] = {}

    def receive(self, key: str, payload: bytes) -> None:
        """Take in a message; drops what is no status or telemetry."""
        if (address := topics.read_key(key)) is None:
            return
        now, vehicle = self._clock(), address.vehicle
        with self._lock, suppress(MessageError):
            if address.topic.name == "telemetry":
                self._telemetry[vehicle] = now, Telemetry.decode(payload, extra="ignore")
            elif address.topic.name == "status" and address.role is not None:
                status = Status.decode(payload, extra="ignore")
                received, last = self._statuses.get((vehicle, address.role), (now, status))
                if replaces(status, last, now - received):
                    self._statuses[vehicle, address.role] = now, status

    def collect(self) -> Iterator[Metric]:
        """All metrics, now."""
        with self._lock:
            now, statuses, telemetry = self._clock(), sorted(self._statuses.items()), dict(self._telemetry)
        build = {"version": version("aeroloop"), "protocol": str(PROTOCOL_VERSION)}
        yield InfoMetricFamily("aeroloop_build", "Version of the exporter, and of SPEC.md", build)
        age = Gauge("aeroloop_status_age_seconds", "Since the last status", labels=_LABELS)
        state = Gauge("aeroloop_state", "1 for the role's state, 0 for the others", labels=(*_LABELS, "state"))
        ticks = Counter("aeroloop_ticks", "Plant: ticks; controller: ticks answered", labels=_LABELS)
        skipped = Counter("aeroloop_skipped_ticks", "Of a session; controller: not answered in time", labels=_LABELS)
        latency = HistogramMetricFamily("aeroloop_latency_seconds", "Measurement sent to its answer", labels=_LABELS)
        trips = Counter("aeroloop_trips", "Trips, and operators' stops", labels=(*_LABELS, "cause"))
        error = Gauge("aeroloop_attitude_error_radians", "Angle; absent without a session", labels=_LABELS)
        expiry = Gauge("aeroloop_certificate_expiry_timestamp_seconds", "Unix time", labels=_LABELS)
        missing = Gauge("aeroloop_recorder_missing", "1 if it disappeared, or is required and absent", labels=_LABELS)
        lost = Counter("aeroloop_recorder_lost_messages", "Missing in its log; some have many ticks", labels=_LABELS)
        for (vehicle, role), (received, status) in statuses:
            labels = vehicle, role
            age.add_metric(labels, now - received)
            for each in {status.state: 1, **dict.fromkeys(_STATES.get(role, ()))}:
                state.add_metric((*labels, each), each == status.state)
            if role in NEEDED:
                ticks.add_metric(labels, status.ticks)
                skipped.add_metric(labels, status.skipped)
                missing.add_metric(labels, status.lacks_recorder is not None)
            if role == "plant":
                for cause in TripCause:  # 0 before the first one, which `increase` would not see otherwise
                    trips.add_metric((*labels, cause), status.trips.get(cause, 0))
            if (counted := status.latency_counts) is not None:
                latency.add_metric(labels, list(zip(_UPPER, counted.counts, strict=True)), counted.sum_us * 1e-6)
            if role == "recorder":
                lost.add_metric(labels, status.lost)
            if status.certificate_until is not None:
                expiry.add_metric(labels, status.certificate_until.timestamp())
            sampled, sample = telemetry.get(vehicle, (-inf, None))
            if role == "controller" and sample and sample.session == status.session and now - sampled < SILENT_S:
                error.add_metric(labels, angle(*sample.attitude_error))
        yield from (age, state, ticks, skipped, latency, trips, error, expiry, missing, lost)


def serve(
    network: NetworkSettings, stop: threading.Event, address: str, port: int, ready: Callable[[str], None]
) -> None:
    """Answer scrapes until `stop` is set; port 0 is any free one. `ready` is called with the URL.

    Raises MetricsError if the address and port cannot be listened on, NetworkError if the network cannot be joined.
    """
    exporter, registry = Exporter(), CollectorRegistry()
    registry.register(exporter)

    def receive(sample: zenoh.Sample) -> None:
        exporter.receive(str(sample.key_expr), sample.payload.to_bytes())

    host = f"[{address}]" if ":" in address else address
    with join(network, listen=False) as session:
        try:
            server, thread = start_http_server(port, address, registry)
        except OSError as error:
            reason = f"{error.strerror or error}".lower()
            raise MetricsError(f"cannot listen on {host}:{port}: {reason}; choose by --address and --port") from None
        for name in ("status", "telemetry"):
            session.declare_subscriber(topics.key(name, "*"), receive)
        ready(f"http://{host}:{server.server_port}/metrics")
        stop.wait()
        server.shutdown()
        server.server_close()
        thread.join()
