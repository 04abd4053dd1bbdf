"""iniVation's AEDAT 2.0 and AEDAT 4."""
