#!/usr/bin/env bash
# Take what a pull request adds out of git, as data: nothing of it is checked out or run.
#
#   collect.sh BASE HEAD OUT      commits, and a new folder that gets entries/ and predictions/
#
# Only new entries and new predictions may be added; anything else needs the eyes of a person.
set -euo pipefail
export LC_ALL=C # in some languages [a-z] holds capitals, too

(($# == 3)) || { echo "usage: collect.sh BASE HEAD OUT" >&2; exit 2; }
base=$1 head=$2 out=$3
most_bytes=${MOST_BYTES:-104857600}
most_files=${MOST_FILES:-20}
files=0

refuse() {
  printf 'refused: %q: %s\n' "$1" "$2" >&2
  exit 1
}

[[ ! -e $out && ! -L $out ]] || refuse "$out" "is there already: files of other submissions may be in it"
trap 'rm -rf -- "$out"' EXIT # of a submission that is refused, nothing stays
mkdir -p -- "$out/entries" "$out/predictions"
# a file, because a failure inside <() would pass for an empty list
git diff --no-ext-diff --no-textconv --no-renames --name-status -z "$base...$head" > "$out/changes"
while IFS= read -r -d '' status && IFS= read -r -d '' path; do
  name=${path##*/}
  [[ $name =~ ^[a-z0-9][a-z0-9._-]{0,250}$ ]] || refuse "$path" "not a name of small letters and digits"
  case $path in
    "leaderboard/entries/$name") [[ $name == *--*.json ]] && kind=entries || refuse "$path" "no entry" ;;
    "submissions/$name") [[ $name == *.h5 ]] && kind=predictions || refuse "$path" "no predictions" ;;
    *) refuse "$path" "a submission adds entries and predictions only" ;;
  esac
  [[ $status == A ]] || refuse "$path" "changes what is there already: a maintainer must look"
  mode=$(git ls-tree "$head" -- "$path" | cut -d ' ' -f 1)
  [[ $mode == 100644 ]] || refuse "$path" "not a plain file"
  bytes=$(git cat-file -s "$head:$path")
  ((bytes <= most_bytes)) || refuse "$path" "$bytes bytes, and $most_bytes are allowed"
  ((++files <= most_files)) || refuse "$path" "more than $most_files files"
  git cat-file blob "$head:$path" > "$out/$kind/$name"
done < "$out/changes"
rm "$out/changes"
((files > 0)) || refuse "$head" "adds nothing"
trap - EXIT
echo "$files files collected"
