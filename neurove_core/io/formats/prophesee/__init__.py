"""RAW (EVT2, EVT3) and DAT files of Prophesee."""
