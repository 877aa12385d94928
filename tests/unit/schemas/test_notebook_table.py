"""What Jupyter shows of a scene and of the client's resources."""

from __future__ import annotations

from schemas.api.jobs import JobResource
from schemas.api.resource import example_of
from schemas.api.scenes import SceneResource
from schemas.notebook_table import notebook_table
from tests.helpers.export_example import make_scene


def test_everything_is_escaped() -> None:
    assert "<script>" not in notebook_table("<script>", {"<script>": "<script>"})


def test_a_scene_in_memory() -> None:
    scene = make_scene()
    page = scene._repr_html_()
    assert page.startswith("<table><caption>Scene of ")
    assert f"<th>points</th><td>{len(scene.points_m)}</td>" in page
    assert "<th>cameras not mounted as given</th><td>none</td>" in page
    scene.calibration[1].__dict__["is_wrong"] = True
    assert f"given</th><td>{scene.drive.cameras[1].name}</td>" in scene._repr_html_()
    assert " px</td>" in page


def test_resources_of_the_client() -> None:
    scene = SceneResource.model_validate(example_of(SceneResource))
    page = scene._repr_html_()
    assert page.startswith("<table><caption>Scene</caption>")
    assert f"<th>id</th><td>{scene.id}</td>" in page
    assert f"<th>summary.points</th><td>{scene.summary.points}</td>" in page
    assert f"<th>files</th><td>{len(scene.files)} entries</td>" in page
    job = JobResource.model_validate(example_of(JobResource))
    assert f"<th>progress.percent</th><td>{job.progress.percent}</td>" in job._repr_html_()
