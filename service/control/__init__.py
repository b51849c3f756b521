"""The control law, its references and the controller end of the loop, sans-I/O."""
