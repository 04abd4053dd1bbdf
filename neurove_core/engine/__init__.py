"""The fast path of inference: NeuroVE on a CPU, equal to the plain PyTorch path; README.md lists each fast form."""
