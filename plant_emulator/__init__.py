"""Plant end of the loop: the endpoint, the plant models, faults, and the processes that run them."""
