"""What a rollout shows of the policy gradient: bias and variance for each λ, response by delay, files for later."""
