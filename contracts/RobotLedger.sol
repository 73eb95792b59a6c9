// SPDX-License-Identifier: Apache-2.0
pragma solidity 0.8.37;

/// @title The ledger of robots: who may write, and what was written.
///
/// A robot is known by Tk = keccak256(name), an identity and not a secret; authority is the sender.
/// What a robot writes are the chunks of its log, byte strings whose content this contract does not
/// look into. They are numbered from 0 in the order written and kept as events; storage keeps their
/// number, the hash of the last one, and one hash for each batch.
///
/// A batch is taken only if it says which chunk it follows: its number, and the hash of the one in
/// front (Raft's rule). So each chunk is written once and in order, however often it is sent and
/// whoever sends it; and a sender that does not know what is there writes nothing.
///
/// Events of one robot are linked: each carries the block of the one before it, and `standings` the
/// block of the last, so a reader walks from block to block and need never scan; the numbers are
/// dense, so a reader sees if a node withholds a batch. `index` in Registered and Revoked is the
/// number of the first chunk for which they hold: which registration governs a chunk needs no clock.
contract RobotLedger {
    /// A robot's account is not topped up beyond this.
    uint256 public constant BALANCE_LIMIT = 5 ether;

    /// A write changes the first two slots and nothing else of it.
    struct Robot {
        address account;
        bool revoked;
        uint40 chunks; // how many were written
        uint40 dataBlock; // of the last Data event; 0 if there is none
        bytes32 tail; // keccak256 of the last chunk; 0 if there is none
        bytes32 certificatesHash; // keccak256 of what Registered carried
        uint256 changedBlock; // of the last Registered or Revoked event
    }

    /// What `standings` answers for one robot; all zero for a name never registered.
    struct Standing {
        address account;
        bytes32 certificatesHash;
        bool revoked;
        uint256 chunks;
        bytes32 tail;
        uint256 balance; // of the account, wei
        uint256 dataBlock;
        uint256 changedBlock;
    }

    address public operator;
    address public offeredOperator;

    mapping(bytes32 Tk => Robot) private robots;

    /// The robot an account was ever bound to: an account serves one robot, for good.
    mapping(address account => bytes32 Tk) public robotOf;

    /// keccak256 over the hashes of a batch's chunks, by the number of its first chunk.
    mapping(bytes32 Tk => mapping(uint256 first => bytes32)) public batch;

    event Registered(
        bytes32 indexed Tk, address indexed account, uint256 index, uint256 previousBlock, bytes certificates
    );
    event Revoked(bytes32 indexed Tk, address indexed account, uint256 index, uint256 previousBlock);
    event Data(
        bytes32 indexed Tk, uint256 indexed first, address indexed account, uint256 previousBlock, bytes[] chunks
    );
    event ETHAllocated(bytes32 indexed Tk, address indexed account, uint256 amount);
    event OperatorOffered(address indexed operator, address indexed offered);
    event OperatorChanged(address indexed previous, address indexed operator);

    error NotOperator(address sender);
    error NotOffered(address sender);
    error ZeroArgument();
    error NotRegistered(bytes32 Tk);
    error AlreadyRegistered(bytes32 Tk, address account);
    error AlreadyRevoked(bytes32 Tk);
    error AccountInUse(address account, bytes32 Tk);
    error NotTheRobot(bytes32 Tk, address sender);
    error NoBalance(address sender);
    error NotNext(bytes32 Tk, uint256 chunks, bytes32 tail);
    error AccountNotRegistered(address account);
    error AboveLimit(address account, uint256 balance);
    error TransferFailed(address account);

    constructor() {
        operator = msg.sender;
        emit OperatorChanged(address(0), msg.sender);
    }

    modifier onlyOperator() {
        if (msg.sender != operator) revert NotOperator(msg.sender);
        _;
    }

    // ------------------------------------------------------------------ the operator

    /// Bind a new robot to an account. The same registration again returns quietly; a used name
    /// is not taken over (see replaceRegistration).
    function registration(bytes32 Tk, address account, bytes calldata certificates)
        external
        onlyOperator
        returns (address)
    {
        Robot storage robot = robots[Tk];
        if (robot.account != address(0)) {
            bool same = robot.account == account && !robot.revoked && robot.certificatesHash == keccak256(certificates);
            if (!same) revert AlreadyRegistered(Tk, robot.account);
            return account;
        }
        return _register(Tk, account, certificates);
    }

    /// Give a used name another account or other certificates; what the old ones could do ends here.
    function replaceRegistration(bytes32 Tk, address account, bytes calldata certificates)
        external
        onlyOperator
        returns (address)
    {
        if (robots[Tk].account == address(0)) revert NotRegistered(Tk);
        return _register(Tk, account, certificates);
    }

    /// End a robot's right to write. What it wrote stays, and stays provable.
    function revokeRobot(bytes32 Tk) external onlyOperator {
        Robot storage robot = robots[Tk];
        if (robot.account == address(0)) revert NotRegistered(Tk);
        if (robot.revoked) revert AlreadyRevoked(Tk);
        robot.revoked = true;
        emit Revoked(Tk, robot.account, robot.chunks, robot.changedBlock);
        robot.changedBlock = block.number;
    }

    /// Pass the value sent on to a robot's account.
    function allocETH(address account) external payable onlyOperator {
        bytes32 Tk = robotOf[account];
        Robot storage robot = robots[Tk];
        if (Tk == 0 || robot.account != account || robot.revoked) revert AccountNotRegistered(account);
        if (account.balance + msg.value > BALANCE_LIMIT) revert AboveLimit(account, account.balance);
        emit ETHAllocated(Tk, account, msg.value);
        (bool done,) = account.call{value: msg.value}("");
        if (!done) revert TransferFailed(account);
    }

    /// Offer the operator's office; it changes hands when the other accepts. Zero withdraws the offer.
    function offerOperator(address offered) external onlyOperator {
        offeredOperator = offered;
        emit OperatorOffered(msg.sender, offered);
    }

    function acceptOperator() external {
        if (msg.sender != offeredOperator) revert NotOffered(msg.sender);
        emit OperatorChanged(operator, msg.sender);
        operator = msg.sender;
        offeredOperator = address(0);
    }

    // ------------------------------------------------------------------ the robot

    /// Write the chunks that follow the first `first` ones, the last of which has the hash `tail`
    /// (0 if there is none).
    function setData(bytes32 Tk, uint256 first, bytes32 tail, bytes[] calldata chunks) external {
        Robot storage robot = robots[Tk];
        if (robot.account == address(0)) revert NotRegistered(Tk);
        if (robot.account != msg.sender) revert NotTheRobot(Tk, msg.sender);
        if (robot.revoked) revert AlreadyRevoked(Tk);
        if (msg.sender.balance == 0) revert NoBalance(msg.sender);
        if (chunks.length == 0) revert ZeroArgument();
        if (first != robot.chunks || tail != robot.tail) revert NotNext(Tk, robot.chunks, robot.tail);

        bytes32[] memory hashes = new bytes32[](chunks.length);
        for (uint256 i = 0; i < chunks.length; ++i) hashes[i] = keccak256(chunks[i]);
        batch[Tk][first] = keccak256(abi.encodePacked(hashes));
        emit Data(Tk, first, msg.sender, robot.dataBlock, chunks);
        robot.tail = hashes[chunks.length - 1];
        (robot.chunks, robot.dataBlock) = (uint40(first + chunks.length), uint40(block.number));
    }

    // ------------------------------------------------------------------ anyone

    /// Is `chunk` the i-th, counted from 0, of the batch that begins with number `first`?
    /// A revoked robot's chunks stay recorded; a name never registered reverts.
    /// @param hashes keccak256 of every chunk of that batch, in order.
    function checkData(bytes32 Tk, uint256 first, bytes32[] calldata hashes, uint256 i, bytes calldata chunk)
        external
        view
        returns (bool)
    {
        if (robots[Tk].account == address(0)) revert NotRegistered(Tk);
        return i < hashes.length && hashes[i] == keccak256(chunk)
            && keccak256(abi.encodePacked(hashes)) == batch[Tk][first];
    }

    /// How these robots stand, in the order asked.
    function standings(bytes32[] calldata Tks) external view returns (Standing[] memory answer) {
        answer = new Standing[](Tks.length);
        for (uint256 i = 0; i < Tks.length; ++i) {
            Robot storage robot = robots[Tks[i]];
            answer[i] = Standing(
                robot.account,
                robot.certificatesHash,
                robot.revoked,
                robot.chunks,
                robot.tail,
                robot.account == address(0) ? 0 : robot.account.balance,
                robot.dataBlock,
                robot.changedBlock
            );
        }
    }

    // ------------------------------------------------------------------ within

    function _register(bytes32 Tk, address account, bytes calldata certificates) private returns (address) {
        if (Tk == 0 || account == address(0)) revert ZeroArgument();
        bytes32 boundTo = robotOf[account];
        if (boundTo != 0 && boundTo != Tk) revert AccountInUse(account, boundTo);
        robotOf[account] = Tk;
        Robot storage robot = robots[Tk];
        robot.account = account;
        robot.revoked = false;
        robot.certificatesHash = keccak256(certificates);
        emit Registered(Tk, account, robot.chunks, robot.changedBlock, certificates);
        robot.changedBlock = block.number;
        return account;
    }
}
