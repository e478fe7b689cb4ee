"""RL Baselines3 Zoo hyperparameter files of sb3-ctco."""
