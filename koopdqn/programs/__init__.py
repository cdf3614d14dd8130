"""Robot programs: a learned path smoothed, timed under the arm's limits, checked and written for controllers."""
