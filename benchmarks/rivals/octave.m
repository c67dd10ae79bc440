1;

% Skins by Octave's control package: octave.m PROBLEM.mat RESULT.mat, timed here with tic and toc.
%
% The same steps as in records.py: harmonics of whole periods, Z_th as the calibration shows it, one
% averaged period of current and voltage, Z(z) of first order, its elements.

function [x, y, f, noise] = harmonics (v_th, v_out, fs, f0)
  periods = floor ((numel (v_th) + 0.5) * f0 / fs);
  samples = min (numel (v_th), round (periods * fs / f0));
  spectra = fft ([v_th(1:samples)(:), v_out(1:samples)(:)]) / samples;
  spectra = spectra(2:ceil (samples / 2), :);
  bins = (1:rows (spectra))';
  of_pulse = mod (bins, periods) == 0;
  if periods > 1
    between = ! of_pulse;
  else
    between = bins > 0.9 * numel (bins);
  end
  noise = median (abs (spectra(between, :)(:)) .^ 2) / log (2);
  if mod (samples, periods) == 0
    of_pulse &= bins < 0.35 * samples;
  end
  x = spectra(of_pulse, 1);
  y = spectra(of_pulse, 2);
  f = bins(of_pulse) * fs / samples;
end

function use = visible (x, y, noise)
  use = min (abs ([x, y, x - y]), [], 2) .^ 2 > 10 * noise;
end

function z_th = driver (v_th, v_out, r_load, fs, f0)
  [x, y, ~, noise] = harmonics (v_th, v_out, fs, f0);
  z_th = r_load * (x - y) ./ y;
  z_th(! visible (x, y, noise)) = NaN;
end

function [current, voltage, rate] = current_and_voltage (v_th, v_out, z_th, fs, f0)
  [x, y, f, noise] = harmonics (v_th, v_out, fs, f0);
  use = visible (x, y, noise) & isfinite (z_th);
  samples = max (round (1e6 / f(1)), 2 * numel (f) + 2);
  spectra = zeros (samples, 2);
  number = find (use) + 1;
  spectra(number, :) = [(x(use) - y(use)) ./ z_th(use), y(use)];
  both = 2 * samples * real (ifft (spectra));
  current = both(:, 1);
  voltage = both(:, 2);
  rate = samples * f(1);
end

function elements = skin (estimator, v_th, v_out, z_th, fs, f0)
  [current, voltage, rate] = current_and_voltage (v_th, v_out, z_th, fs, f0);
  most = [max(abs (current)), max(abs (voltage))];
  current /= most(1);
  voltage /= most(2);
  switch estimator
    case "arx"
      % it lets no input act at once: the input is advanced by a sample
      z = arx (iddata (voltage, circshift (current, -1), 1 / rate), "na", 1, "nb", 2);
      [b, a] = tfdata (z, "vector");
      if iscell (b)  % the second input is the noise
        b = b{1};
        a = a{1};
      end
      b = b(end-1:end);
    case "n4sid"
      [a, b, c, d] = ssdata (n4sid (iddata (voltage, current, 1 / rate), "n", 1));
      b = [d, c * b - a * d];
      a = [1, -a];
  end
  r_s = (b(1) - b(2)) / (1 - a(2));
  r = (b(1) + b(2)) / (1 + a(2));
  unit = most(2) / most(1);
  elements = [unit * r_s, unit * (r - r_s), (1 - a(2)) / (1 + a(2)) / (2 * rate) / (unit * (r - r_s))];
end

pkg load control
warning ("off", "all");
paths = argv ();
p = load (paths{1});
draws = numel (p.r_ref);
elements = nan (draws, 3);
seconds = driver_seconds = nan (draws, 1);
first_seconds = NaN;
errors = repmat ({""}, draws, 1);
for i = 1:draws
  try
    tic;
    z_th = driver (p.ref_th(i, :), p.ref_out(i, :), p.r_ref(i), p.fs, p.f0);
    driver_seconds(i) = toc;
    runs = nan (p.repeats, 1);
    for j = 0:p.repeats
      begin = tic;
      found = skin (p.estimator, p.v_th(i, :), p.v_out(i, :), z_th, p.fs, p.f0);
      if j > 0
        runs(j) = toc (begin);
      elseif isnan (first_seconds)
        first_seconds = toc (begin);
      end
    end
    seconds(i) = median (runs);
    elements(i, :) = found;
  catch problem
    errors{i} = problem.message;
  end
end
errors = jsonencode (errors);
control = pkg ("list", "control"){1}.version;
octave = version ();
save ("-v6", paths{2}, "elements", "seconds", "driver_seconds", "first_seconds", "errors", "control", "octave");
