"""Other engines as plants: MuJoCo models and FMUs."""
