import pytest

from semantic2d_dataset.publishing.licenses import find_spdx, hugging_face_license, license_address


@pytest.mark.parametrize(
    ("text", "spdx", "hub", "address"),
    [
        ("mit", "MIT", "mit", "https://spdx.org/licenses/MIT.html"),
        ("CC-BY-4.0", "CC-BY-4.0", "cc-by-4.0", "https://spdx.org/licenses/CC-BY-4.0.html"),
        ("ODbL-1.0", "ODbL-1.0", "odbl", "https://spdx.org/licenses/ODbL-1.0.html"),
        ("GPL-3.0-only", "GPL-3.0-only", "gpl-3.0", "https://spdx.org/licenses/GPL-3.0-only.html"),
        ("LicenseRef-Ours", "LicenseRef-Ours", "other", "LicenseRef-Ours"),
        ("MIT OR Apache-2.0", "MIT OR Apache-2.0", "other", "MIT OR Apache-2.0"),
        ("unknown", None, "unknown", "unknown"),
        ("ask me", None, "other", "ask me"),
    ],
)
def test_licences_by_all_their_names(text, spdx, hub, address):
    assert find_spdx(text) == spdx
    assert hugging_face_license(text) == hub
    assert license_address(text) == address
