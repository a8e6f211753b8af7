% Reads a region of the first variable of a .fhz file: read_region("run.fhz"), in Octave or MATLAB.
function read_region(path)
  [~, name, units, n] = fhash_read(path, 0, 0, [0 1 0 1 0 1]);
  fprintf("%s (%d, %d, %d, %d) %s\n", name, n, units);
  half = ceil(n(2:4) / 2);
  % the first half of each axis, at the middle of the steps, which may lie between two
  values = fhash_read(path, 0, (n(1) - 1) / 2, [0 half(1) 0 half(2) 0 half(3)]);
  known = values(~isnan(values)); % missing values, and those outside the features, are NaN
  fprintf("last %.9g mean %.12g of %d\n", values(end), mean(known), numel(known));
end
