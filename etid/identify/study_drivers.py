"""The drivers of a study, each from its calibrations."""

import threading

from etid.identify.driver import calibrated
from etid.identify.options import Options
from etid.recordings.recording import Recording, RecordingError
from etid.recordings.study import Study
from etid.results.driver import Driver
from etid.results.feed import MEASURED_CURRENT, AbstractFeed
from etid.results.fit import IdentificationError


class Drivers:
    """The drivers of a study; each is identified when its first recording needs it.

    Attributes:
        found: The identified drivers. The keys are the paths of their calibrations.
        failures: Reasons why a driver could not be identified. The keys are the paths of its
            calibrations.
    """

    def __init__(self, study: Study, options: Options) -> None:
        self.study = study
        self.options = options
        self.calibrations = tuple(study.calibrations)
        self.found: dict[tuple[str, ...], Driver] = {}
        self.failures: dict[tuple[str, ...], str] = {}
        self._one_at_a_time = threading.Lock()

    def fed(self, recording: Recording) -> tuple[Recording, AbstractFeed]:
        """A recording and its driver; or its measured current, if it has no calibration.

        Raises:
            RecordingError: As in `of`.
            IdentificationError: As in `of`.
        """
        calibrated = recording.calibration or self.calibrations
        if recording.cause == "current" or ("current" in recording.samples and not calibrated):
            return recording.without_v_th(), MEASURED_CURRENT
        return recording, self.found[self.of(recording)]

    def of(self, recording: Recording) -> tuple[str, ...]:
        """Paths of the calibrations of a recording; their driver is then in `found`.

        Raises:
            RecordingError: The recording names no calibration, and the study does not have exactly
                one.
            IdentificationError: The driver could not be identified.
        """
        names = recording.calibration or self.calibrations
        if not recording.calibration and len(self.calibrations) != 1:
            raise RecordingError(
                f"names no calibration and the study has {len(self.calibrations)}",
                path=recording.path,
                field="calibration",
                remedy="Write the path of its calibration into the attribute 'calibration'"
                if self.calibrations
                else "Add a recording of a known resistor: etid import --calibration FILE OHM",
            )
        with self._one_at_a_time:
            if names not in self.found and names not in self.failures:
                self._identify(names)
        if names in self.failures:
            raise IdentificationError(self.failures[names], None)
        return names

    def _identify(self, names: tuple[str, ...]) -> None:
        try:
            records = [self.study[name] for name in names]
            self.found[names] = calibrated(records, self.options, throw=False)
        except (IdentificationError, ValueError, KeyError) as error:
            self.failures[names] = str(error)
