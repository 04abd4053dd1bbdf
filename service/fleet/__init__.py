"""The nodes of a deployment as one fleet: who is there, who does not answer, and rollouts in steps."""
