"""Experiments on top of the core: what a map is worth.

A simulated drive, and what is made of it:

  world           what the beams meet, and when it is there
  generators      worlds to test in, from numbers or a PRNG key
  check           whether a world, and a drive through it, is possible
  raycast         where a beam meets a world first
  robot           how it drives, what its wheels count, what it believes of its pose
  scanners        models of instruments: a world and a pose -> a scan
  simulate        all of these: a whole log
  scoring         a map held against the truth
  trials          a drive, mapped and scored; by the thousand
  batch           many runs side by side, over devices and hosts
  consistency     whether covariances of lines hold; `consistency_of_circles`, those of circles

A real log, and maps of it:

  calibration     the noise of the scanner and of the poses
  evaluation      what a map is worth without a truth
  occupancy       the grid of free and occupied cells
  comparison      what differs between two maps of one place

And the paper:

  verification    its equations, one by one: exact, erratum or assumption
"""
