from leaderboard.adding import add_entry
from leaderboard.entries import PUBLISHED, read_entry
from leaderboard.published import doubtful_means, published_entries
from semantic2d_dataset.scoring.published import published_segmentation


def test_every_row_of_the_paper_becomes_an_entry_marked_as_published(tmp_path):
    paths = [add_entry(entry, tmp_path) for entry in published_entries()]
    assert len(set(paths)) == len(published_segmentation().rows)
    for path, row in zip(paths, published_segmentation().rows, strict=True):
        entry = read_entry(path)
        assert entry.kind == PUBLISHED
        assert entry.digest == ""
        assert entry.said["figures"]["IoU"]["All"] == list(row.figures["IoU"]["All"])
        assert entry.said["source"]["data"] == "https://doi.org/10.5281/zenodo.18350696"


def test_a_mean_that_is_not_that_of_its_classes_is_found():
    figures = {
        "IoU": {"All": [0.5, None], "Door": [0.4, None], "Wall": [0.6, None]},
        "CA": {"All": [0.51, None], "Door": [0.4, None], "Wall": [0.6, None]},
    }
    assert doubtful_means(figures) == {"CA": 0.5}
