"""AEDAT 2.0 and AEDAT4 files of iniVation cameras."""
