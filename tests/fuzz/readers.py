"""Every reader of the package, as the fuzzer sees it: one entry each, see `describe.Reader`."""

from tests.fuzz.area_readers import AREAS
from tests.fuzz.capture_readers import CAPTURES
from tests.fuzz.checkpoint_readers import CHECKPOINTS
from tests.fuzz.report_readers import REPORTS
from tests.fuzz.scene_readers import SCENES
from tests.fuzz.splat_readers import SPLATS
from tests.fuzz.structure_readers import STRUCTURE
from tests.fuzz.task_readers import TASKS
from tests.fuzz.tracking_readers import TRACKING

ALL = [*CHECKPOINTS, *CAPTURES, *STRUCTURE, *SCENES, *REPORTS, *AREAS, *TASKS, *TRACKING, *SPLATS]
READERS = [r for r in ALL if r.installed]
