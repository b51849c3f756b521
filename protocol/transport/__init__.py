"""Links over Zenoh and CAN, the network session, and publication with recovery."""
