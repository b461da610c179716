"""The learner: networks, advantages and PPO. It knows arrays and no environment."""
