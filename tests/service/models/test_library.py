import os

from neurove_core.models import bundle
from neurove_service.models.library import Library
from tests.bundles import make_bundle


def test_a_bundle_replaced_by_one_of_equal_size_and_time_is_read_again(tmp_path):
    path, other = tmp_path / "a.safetensors", tmp_path / "other"
    bundle.save(make_bundle(seed=1), path)
    library = Library(tmp_path)
    first = bundle.load(path)
    assert first.digest in {one.digest for one in library.available().models}
    other.write_bytes(make_bundle(seed=2).to_bytes())
    os.utime(other, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns))
    assert other.stat().st_size == path.stat().st_size
    other.replace(path)
    second = bundle.load(path)
    digests = {one.digest for one in library.available().models}
    assert second.digest != first.digest
    assert second.digest in digests
    assert first.digest not in digests
    assert library.find(second.digest).digest == second.digest


def test_a_folder_of_models_that_cannot_be_read_is_listed_with_the_reason(tmp_path):
    (tmp_path / "file").touch()
    for folder, why in ((tmp_path / "none", "No such file or directory"), (tmp_path / "file", "Not a directory")):
        assert Library(folder).available().unreadable == {str(folder): why}
