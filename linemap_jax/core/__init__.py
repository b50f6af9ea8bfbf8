"""The method: pure functions on arrays; no files, no printing.

The modules in the order in which data flows through them:

  fields          what the fields of a class mean, for `help`
  state           the data: Scan, Pose, Lines, Circles, Extraction, LineMap, Report, Status
  settings        the choices: Thresholds, SensorNoise, Mount, Rules, Capacity, presets
  sweep           where a scan that sees all around begins
  frames          angles and directions; `frames_on_host`, the same in NumPy
  propagation     covariance of f(x) from the covariance of x
  slots           padded slots: finding, taking, putting
  branching       decisions that a batch makes together
  sensor          section 4.2, scan and pose -> points, Eqs. (2)-(4)
  runs            which points belong to which
  segmentation    section 4.3, points -> runs: `incremental`, the paper's criteria; `optimal` and `polyline`, the best
  lines           sections 4.2.2 to 4.2.5, runs -> lines, Eqs. (5)-(17); `likelihood`, the most likely ones
  circles         section 4.3 (circles), what is left over -> circles, Eqs. (18)-(20)
  extract         all of these: a scan -> Extraction
  matching        sections 5.1.1 and 5.2.1, which line of the scan is which of the map, Eqs. (21)-(22)
  fusion          sections 5.1.2 and 5.2.2, a better estimate from both, Eqs. (23)-(25)
  wiping          section 6, what is no longer there
  mapping         all of these: a scan into the map
  merging         two maps into one
  estimation      sections 3 and 8, where the robot is
"""
