"""Files and pictures: logs in, maps out.

Logs, and what is read with them:

  reading         what a log is: a stream of `Reading`s, and notes about what was odd
  log             opens one, whatever its format
  carmen          CARMEN logs; `carmen_writer` writes them
  bags            ROS bags; `bag_file` opens one, `frames` knows where frames were over time
  tum             trajectories, read and written
  scans           readings -> stacked scans and poses, a chunk at a time
  survey          what a log holds
  config          settings from a TOML file, and into one

Maps, and what is drawn of them:

  map_file        the map as JSON, without loss
  exports         all formats in one table: `geojson`, `svg`, `dxf`, `nav2`, `mcap`, `plot`, `html`
  shapes          what most of these draw
  jsonl           extractions, one a line
  worlds          simulated worlds as GeoJSON
  table           results of experiments as Parquet

And beneath:

  atomic          files that are there in full or not at all
  json_file       JSON from a file, or what is wrong with it
  thinned         a long stream in a short list
  programs        compiled programs, kept on the disk
"""
