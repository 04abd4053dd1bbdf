"""Neurons, cells and their surrogate gradient: one file for each, with its equation and its source.

| equation (NeuroVE, or the paper cited)                     | file         | reference implementation |
|------------------------------------------------------------|--------------|--------------------------|
| (1), (4), (5) LIF neuron                                   | lif.py       | lif_step                 |
| (2), (3), (6a), (6b) astrocyte diffusion J, ALIF neuron    | alif.py      | diffuse, alif_step       |
| (6c) spike, its surrogate gradient (Wu 2018)               | surrogate.py | spike                    |
| (7), (9) ASLSTM cell                                       | aslstm.py    | aslstm_step              |
| (8) output neurons O                                       | readout.py   | readout_step             |
| SLSTM cell (Henkes 2024)                                   | slstm.py     | slstm_step               |
| LTC neuron (Yin 2023)                                      | ltc.py       | ltc_step                 |

Notation in the docstrings: a name is the value of this step, a name with a prime (v') the value of the step before.
`plain.py` switches to the plain PyTorch path, `layers.py` has what the modules share, `fused/` has the compiled forms.
"""
