"""Plants computed by simulation engines that are optional extras."""
