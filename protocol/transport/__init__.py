"""Links over Zenoh and CAN, the network session, messages and their history."""
