"""As Quanser's module of this name."""

from tests.support.fake_quanser import BufferOverflowMode

__all__ = ["BufferOverflowMode"]
