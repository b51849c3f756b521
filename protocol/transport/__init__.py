"""Links over Zenoh and CAN, the network session, and publication from a cache."""
