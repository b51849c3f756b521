"""Address of a vehicle: its name and the network. All that a command of `aeroloop op` needs of a configuration.

Why such a command reads nothing else: it starts sooner, and a mistake in another section does not keep it from stopping
a plant. Names of sections are checked all the same: what stands in `[netwrok]` would otherwise be missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Self

from pydantic import BaseModel, Field, StringConstraints, ValidationError, model_validator

from aeroloop.protocol.messages import topics
from aeroloop.protocol.transport.network_settings import NetworkSettings
from aeroloop.protocol.wording import closest, problems
from aeroloop.service.config_sources import ConfigError, merge, sources

UNREAD: Final = ("loop", "wire", "reference", "law", "controller", "plant", "can", "recorder")
"""The other sections of a configuration."""


class VehicleAddress(BaseModel, extra="forbid", coerce_numbers_to_str=True):
    """Name of a vehicle, and the network on which it is."""

    vehicle: Annotated[str, StringConstraints(pattern=f"^{topics.NAME}$")] = Field(
        default="aero", description="name of the vehicle, one chunk of every key"
    )
    network: NetworkSettings = Field(
        default=NetworkSettings(), description="Zenoh endpoints of this process and of others"
    )

    @model_validator(mode="after")
    def _messages_of_its_own_vehicle_are_taken(self) -> Self:
        """Name the vehicle among those whose peers have rights, wherever certificates give them."""
        security = self.network.security
        if security.directory and self.vehicle not in security.vehicles:
            named = security.model_copy(update={"vehicles": [self.vehicle, *security.vehicles]})
            self.network = self.network.model_copy(update={"security": named})
        return self


def load_vehicle_address(file: Path | None = None, overrides: Sequence[str] = ()) -> VehicleAddress:
    """Vehicle and network of a configuration; arguments as of `config.load`.

    Raises:
        ConfigError: A source cannot be read, a section is unknown, or vehicle or network is wrong.
    """
    tree: dict[str, Any] = {}
    for given in sources(file, overrides, VehicleAddress, UNREAD):
        merge(tree, {name: value for name, value in given.items() if name not in UNREAD})
    sections = (*VehicleAddress.model_fields, *UNREAD)
    for name in set(tree).difference(sections):
        found = closest(name, sections)
        raise ConfigError(
            f"unknown key {name}" + (f": did you mean {found}?" if found else f"; there are {', '.join(sections)}")
        )
    try:
        return VehicleAddress.model_validate(tree)
    except ValidationError as error:
        raise ConfigError("; ".join(problems(error, VehicleAddress))) from None
