"""What a store holds: its data card (text and picture), and a few lines for the terminal."""

from __future__ import annotations

from pathlib import Path

from envs.card import Card, card_text
from envs.files import write_bytes
from envs.shards import read_record
from envs.store import Manifest, SceneStore

CARD_FILE, CARD_PICTURE = "card.md", "card.png"


def write_card(folder: Path, manifest: Manifest) -> None:
    """Write the data card of a store, as Markdown and as a picture.

    Args:
        folder: of the store.
        manifest: of the store, complete.
    """
    from envs.render.card import draw_card  # matplotlib takes a second to import, and every recipe may convert scenes
    from envs.render.save import save_picture

    card = Card()
    for shard in manifest.shards:
        card.merge(read_record(folder / shard["name"]).card)
    size = sum((folder / shard["name"]).stat().st_size for shard in manifest.shards)
    facts = {
        "source": manifest.source,
        "split": manifest.options["split"] or "(no name)",
        "shards": f"{len(manifest.shards)} of up to {manifest.options['shard_size']} scenes",
        "size": f"{size / 1e6:.1f} MB, {size / 1e3 / card.counts['scenes']['all']:.0f} KB for a scene",
        "made of": ", ".join(manifest.named) or "(not noted)",
        "plan": manifest.plan,
    }
    errors = [skip["error"] for skip in manifest.skipped]
    text = card_text(card, "Scenes", facts, errors, manifest.notes)
    write_bytes(folder / CARD_FILE, text.encode(errors="backslashreplace"))  # of a folder not named in UTF-8
    save_picture(folder / CARD_PICTURE, [draw_card(card)])


def describe(store: SceneStore) -> str:
    """What a store of one folder holds, as text of a few lines."""
    (folder,), (manifest,) = store.folders, store.manifests
    size = sum((folder / shard["name"]).stat().st_size for shard in manifest.shards)
    options = ", ".join(f"{name} {value}" for name, value in manifest.options.items() if value not in ("", None))
    lines = [
        f"{folder}",
        f"  source    {manifest.source}: {', '.join(manifest.named) or 'not noted'}",
        f"  options   {options}",
        f"  scenes    {len(store)} in {len(manifest.shards)} shards, {store.has_lights.sum()} with traffic lights",
        f"  agents    {store.num_agents.mean():.1f} in a scene at the current step, {store.num_agents.max()} at most",
        f"  size      {size / 1e6:.1f} MB, {size / 1e3 / len(store):.0f} KB per scene",
        f"  card      {folder / CARD_FILE}",
        f"  noted     {sum(manifest.notes.values())}",
        *(f"    {note}: {count} times" for note, count in manifest.notes.items()),
        f"  skipped   {len(manifest.skipped)}",
        *(f"    {skip['error']}" for skip in manifest.skipped),
    ]
    return "\n".join(lines)
