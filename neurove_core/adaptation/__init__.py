"""Adaptation: from the recorded drive of one robot to a bundle that is measurably better on that robot."""
